"""What one run leaves behind: its folder, its numbers, its checkpoints, its best policy."""

import collections
import contextlib
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from segvisrl_jax.agent.networks import Params
from segvisrl_jax.config import ConfigError, TrainConfig, flatten, to_dict
from segvisrl_jax.training.checkpoint import Checkpoints, save_policy
from segvisrl_jax.training.metrics import MetricsWriter
from segvisrl_jax.training.processes import Processes
from segvisrl_jax.training.rollout import EpisodeLog
from segvisrl_jax.training.trackers import open_trackers
from segvisrl_jax.types import Outcome

RECENT_EPISODES = 200  # what the progress bar's shares are taken over
FREE_ON_RESUME = (
    "steps", "resume", "runs_dir", "run", "evaluation", "checkpoint_every_updates", "preset", "loggers",
    "num_devices", "num_seeds", "coordinator", "num_processes", "process_id",
)  # fmt: skip
OUTCOMES = (Outcome.SUCCESS, Outcome.COLLISION, Outcome.FALL, Outcome.TIMEOUT)


@dataclasses.dataclass
class HostState:
    """Everything on the host that goes into a checkpoint, as JSON data."""

    updates: int = 0
    seconds: float = 0.0  # spent training, over all sessions of the run
    recent: list[list[float]] = dataclasses.field(default_factory=list)  # outcome, return, decisions
    best: list[float] = dataclasses.field(default_factory=list)  # rank of the best policy so far


class Run:
    """The bookkeeping of a run whose folder is open. Of several processes, the first one alone writes numbers."""

    def __init__(self, config: TrainConfig, processes: Processes, say: Callable[[str], None]):
        """Opens what is written to.

        Raises:
            ConfigError: where a logger cannot be opened.
        """
        self.config, self.say = config, say
        self.folder = Path(config.runs_dir) / config.run_name
        self.host = HostState()
        self._recent: collections.deque[list[float]] = collections.deque(maxlen=RECENT_EPISODES)
        self._is_first = processes.is_first
        with contextlib.ExitStack() as stack:
            self._writer = None
            if self._is_first:
                trackers = open_trackers(config, self.folder)
                self._writer = stack.enter_context(MetricsWriter(self.folder, trackers=trackers, say=say))
            self._checkpoints = Checkpoints(self.folder)
            stack.callback(self._checkpoints.close)
            self._open = stack.pop_all()

    def restore(self, like: Any) -> Any:
        """The state of the newest checkpoint, and what the host knew then.

        Raises:
            ConfigError: where there is none, or it does not fit.
        """
        state, data = self._checkpoints.restore_latest(like)
        self.host = HostState(**data)
        self._recent.extend(self.host.recent)
        self.say(f"going on from update {self.host.updates} of {self.config.num_updates}")
        return state

    def begin(self) -> None:
        """Drops the numbers of updates that are going to be made again."""
        if self._writer:
            self._writer.resume_at(self.decisions)

    def count(self, metrics: dict[str, Any], log: EpisodeLog, seconds: float) -> dict[str, float]:
        """Counts one update, and gives its row of numbers."""
        self._recent.extend(_finished_episodes(log))
        self.host.recent = [list(episode) for episode in self._recent]
        self.host.updates += 1
        self.host.seconds += seconds
        speed = self.config.ppo.decisions_per_update / seconds
        times = {"time/seconds": self.host.seconds, "time/decisions_per_second": speed}
        return _row(metrics, log, self._recent) | times

    def judge(self, summary: dict[str, Any], params: Params) -> dict[str, float]:
        """Keeps a policy that is as good as the best so far, and gives the row of its evaluation."""
        rank = [summary["success"], -summary["collision"], summary["spl"]]
        if rank >= (self.host.best or rank):
            self.host.best = rank
            scores = {**summary, "scenes": "validation", "decisions": self.decisions}
            if self._is_first:
                save_policy(self.folder / "policy", self.config, params, scores)
        low, high = summary["success_ci95"]
        kept = {k: v for k, v in summary.items() if isinstance(v, float)}
        kept |= {"success_low": low, "success_high": high}
        return {f"evaluation/{name}": value for name, value in kept.items()}

    def write(self, row: dict[str, float]) -> None:
        """Writes a row to every logger."""
        if self._writer:
            self._writer.write(self.decisions, row)

    def save(self, state: Any) -> None:
        """Writes a checkpoint."""
        self._checkpoints.save(self.host.updates, state, dataclasses.asdict(self.host))

    def close(self) -> None:
        """Ends what is written to."""
        self._open.close()

    @property
    def decisions(self) -> int:
        """How many have been made."""
        return self.host.updates * self.config.ppo.decisions_per_update


def open_run_dirs(config: TrainConfig) -> None:
    """``open_run_dir`` for every seed; where one is refused, none is made."""
    made = []
    try:
        for run in config.runs:
            folder = Path(run.runs_dir) / run.run_name
            is_new = not folder.exists()
            open_run_dir(run)
            made += [folder] if is_new else []
    except ConfigError:
        for folder in made:
            shutil.rmtree(folder)
        raise


def open_runs(config: TrainConfig, processes: Processes, say: Callable[[str], None]) -> list[Run]:
    """The run of every seed; where a logger fails, new runs leave no folders behind that would be in the way.

    Raises:
        ConfigError: where a logger cannot be opened.
    """
    opened: list[Run] = []
    try:
        for settings in config.runs:
            opened.append(Run(settings, processes, say))
    except ConfigError:
        for run in opened:
            run.close()
        if not config.resume:
            for settings in config.runs:
                shutil.rmtree(Path(settings.runs_dir) / settings.run_name)
        raise
    return opened


def open_run_dir(config: TrainConfig) -> Path:
    """Makes the run's folder and writes the resolved config, or checks that it can be resumed.

    Raises:
        ConfigError: where it exists already and ``resume`` is off, or has nothing to resume, or was another run.
    """
    run_dir = Path(config.runs_dir) / config.run_name
    config_file = run_dir / "config.json"
    if not config.resume:
        if run_dir.exists() and any(run_dir.iterdir()):
            raise ConfigError(f"run = {str(run_dir)!r}: exists already; go on with --resume, or choose another --run")
        run_dir.mkdir(parents=True, exist_ok=True)
        config_file.write_text(json.dumps(to_dict(config), indent=2) + "\n")
        return run_dir
    if not (run_dir / "checkpoints").is_dir() or not config_file.is_file():
        raise ConfigError(f"run = {str(run_dir)!r}: has no checkpoint to resume; leave --resume out")
    _require_same_run(config, json.loads(config_file.read_text()), run_dir)
    return run_dir


def _require_same_run(config: TrainConfig, before: dict[str, Any], run_dir: Path) -> None:
    """Only the number of steps and bookkeeping may change when a run goes on. What old runs do not say is neutral."""
    now = flatten(json.loads(json.dumps(to_dict(config))))
    then = flatten(to_dict(TrainConfig())) | flatten(before)
    for name, value in now.items():
        if name.split(".")[0] not in FREE_ON_RESUME and value != then.get(name):
            raise ConfigError(f"{name} = {value!r}: should be {then.get(name)!r}, as when {run_dir} was started")


def _finished_episodes(log: EpisodeLog) -> list[list[float]]:
    """(outcome, return, decisions) of the episodes that ended, in the order of time."""
    outcome, returns, lengths = jax.device_get((log.outcome, log.episode_return, log.num_decisions))
    ended = np.nonzero(outcome != Outcome.RUNNING)
    return [[int(outcome[i]), float(returns[i]), int(lengths[i])] for i in zip(*ended, strict=True)]


def _row(metrics: dict[str, Any], log: EpisodeLog, recent) -> dict[str, float]:
    """What one update has to say, by the names that the log file uses."""
    row = {f"ppo/{name}": float(value) for name, value in metrics.items()}
    for name in ("progress", "collision", "fall", "timeout"):
        row[f"reward/{name}"] = float(np.mean(jax.device_get(getattr(log.terms, name))))
    if recent:
        episodes = np.array(recent)
        for kind in OUTCOMES:
            row[f"episode/{kind.name.lower()}"] = float(np.mean(episodes[:, 0] == kind))
        row["episode/return"] = float(np.mean(episodes[:, 1]))
        row["episode/decisions"] = float(np.mean(episodes[:, 2]))
    return row

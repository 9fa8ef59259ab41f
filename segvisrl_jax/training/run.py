"""What one run leaves behind: its folder, its numbers, its checkpoints, its best policy."""

import collections
import contextlib
import dataclasses
import functools
import json
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from segvisrl_jax.agent.networks import Params
from segvisrl_jax.config import BOOKKEEPING, ConfigError, TrainConfig, flatten, one_line, read_json, to_dict
from segvisrl_jax.training.checkpoint import Checkpoints, load_policy, save_policy
from segvisrl_jax.training.manifest import replace_file
from segvisrl_jax.training.metrics import METRICS_FILE, MetricsWriter, read_metrics
from segvisrl_jax.training.processes import Processes
from segvisrl_jax.training.rollout import EpisodeLog
from segvisrl_jax.training.run_lock import RunLock, is_being_trained
from segvisrl_jax.training.trackers import open_trackers
from segvisrl_jax.types import Outcome

RECENT_EPISODES = 200  # what the progress bar's shares are taken over
# Not evaluation.rocks and evaluation.episodes: the best policy so far was judged by them.
FREE_ON_RESUME = (*BOOKKEEPING, "steps", "preset", "evaluation.every_decisions", "evaluation.num_slots")
OUTCOMES = (Outcome.SUCCESS, Outcome.COLLISION, Outcome.FALL, Outcome.TIMEOUT, Outcome.UNSTABLE)
SECONDS = "time/seconds"  # the number that tells how long a run has trained
PATIENCE_S = 3.0  # with another thread that writes the policy
OURS = ("lock",)  # what may be in a folder that no run has begun in, besides half-written files


@dataclasses.dataclass
class HostState:
    """Everything on the host that goes into a checkpoint, as JSON data."""

    updates: int = 0
    seconds: float = 0.0  # spent training, over all sessions of the run
    recent: list[list[float]] = dataclasses.field(default_factory=list)  # outcome, return, decisions
    best: list[float] = dataclasses.field(default_factory=list)  # rank of the best policy so far
    unstable: int = 0  # episodes that the physics ended


class Run:
    """The bookkeeping of a run whose folder is open. Of several processes, the first one alone writes numbers.

    What cannot be written is said once, and tried again: a full disk or a folder that is gone ends no run.
    """

    def __init__(self, config: TrainConfig, processes: Processes, say: Callable[[str], None]):
        """Opens what is written to.

        Raises:
            ConfigError: where another process has the folder, a logger cannot be opened, or no checkpoint is whole.
        """
        self.config, self.say = config, say
        self.folder = Path(config.runs_dir) / config.run_name
        self.host = HostState()
        self.num_saved: int | None = None  # updates behind the newest checkpoint
        self._recent: collections.deque[list[float]] = collections.deque(maxlen=RECENT_EPISODES)
        self._is_first, self._is_alone = processes.is_first, processes.count == 1
        self._lock: RunLock | None = None
        self._policy: tuple[Params, dict[str, Any]] | None = None  # the best, with its scores
        self._policy_is_waiting = False
        self._writing_policy = threading.Lock()
        self._best_on_disk: list[float] = []  # rank of the policy there
        self._failing: set[str] = set()
        with contextlib.ExitStack() as stack:
            self._writer: MetricsWriter | None = None
            processes.on_first(lambda: self._open_writer(stack))
            self._checkpoints = Checkpoints(self.folder, processes, say)
            self.num_saved = self._checkpoints.latest
            stack.callback(self._checkpoints.close)
            self._open = stack.pop_all()

    def _open_writer(self, stack: contextlib.ExitStack) -> None:
        self._lock = stack.enter_context(contextlib.closing(RunLock(self.folder)))
        trackers = open_trackers(self.config, self.folder)
        self._writer = stack.enter_context(MetricsWriter(self.folder, trackers=trackers, say=self.say))

    def restore(self, like: Any) -> Any:
        """The state of the newest checkpoint, and what the host knew then.

        Raises:
            ConfigError: where there is none, or it does not fit.
        """
        state, data = self._checkpoints.restore_latest(like)
        unknown = sorted(set(data) - {field.name for field in dataclasses.fields(HostState)})
        if unknown:
            raise ConfigError(f"{self.folder}: its checkpoint is of a newer version of segvisrl_jax ({unknown[0]})")
        self.host = HostState(**data)
        if self._is_first:
            self._find_policy()
        self._recent.clear()
        self._recent.extend(self.host.recent)
        self.say(f"going on from update {self.host.updates} of {self.config.num_updates}")
        return state

    def require_nothing_lost(self) -> None:
        """Where there is no checkpoint: checks that there never was one.

        Raises:
            ConfigError: where there was.
        """
        if self._checkpoints.are_lost:
            raise ConfigError(
                f"run = {str(self.folder)!r}: had checkpoints, and has none now; put its checkpoints/ back, or start "
                "again under another --run"
            )

    def can_go_on_from(self) -> set[int]:
        """Updates behind its whole checkpoints, and 0 where beginning again costs no more than one of them.

        Raises:
            ConfigError: where its checkpoints are lost.
        """
        self.require_nothing_lost()
        has_only_begun = (self.num_saved or 0) <= self.config.checkpoint_every_updates
        return self._checkpoints.whole() | ({0} if has_only_begun else set())

    def go_back_to(self, updates: int) -> None:
        """Removes what was saved after ``updates``: it is made again."""
        if (self.num_saved or 0) == updates:
            return
        self.say(f"{self.folder}: goes back from update {self.num_saved} to {updates}, where all seeds were saved")
        self._checkpoints.go_back_to(updates)
        self.num_saved = self._checkpoints.latest

    def _find_policy(self) -> None:
        """Reads the best policy, to put it back if it vanishes; a later one takes its place where it is not there."""
        if not self.host.best:
            return
        try:
            source, params, scores = load_policy(self.folder / "policy")
            require_policy_of(self.folder, source)
            self._policy, self._best_on_disk = (params, scores), _rank(scores)
        except (ConfigError, KeyError, TypeError) as error:
            self.say(f"warning: the best policy so far is not there ({one_line(error)}); the next one is kept")
        self.host.best = min(self.host.best, self._best_on_disk)

    def begin(self) -> None:
        """Drops the numbers of updates that are going to be made again."""
        if self._writer:
            self._writer.resume_at(self.decisions)
            self._tell_wrong_numbers()

    def _tell_wrong_numbers(self) -> None:
        """Says where lines so far are missing, or another run's: a checkpoint knows the time in its last line."""
        rows, updates = read_metrics(self.folder), self.host.updates
        if len(rows) < updates:
            self.say(f"warning: {METRICS_FILE}: {updates - len(rows)} of {updates} lines are missing; the run goes on")
        elif rows and rows[-1].get(SECONDS, self.host.seconds) != self.host.seconds:
            self.say(f"warning: {METRICS_FILE}: its lines are not those of this run's checkpoint; the run goes on")

    def count(self, metrics: dict[str, Any], log: EpisodeLog, seconds: float) -> dict[str, float]:
        """Counts one update, and gives its row of numbers."""
        ended = _finished_episodes(log)
        self._recent.extend(ended)
        self.host.unstable += sum(outcome == Outcome.UNSTABLE for outcome, _, _ in ended)
        self.host.recent = [list(episode) for episode in self._recent]
        self.host.updates += 1
        self.host.seconds += seconds
        speed = self.config.ppo.decisions_per_update / seconds
        times = {SECONDS: self.host.seconds, "time/decisions_per_second": speed}
        return _row(metrics, log, self._recent) | times | {"episode/num_unstable": float(self.host.unstable)}

    def judge(self, summary: dict[str, Any], params: Params) -> dict[str, float]:
        """Keeps a policy that is as good as the best so far, and gives the row of its evaluation."""
        rank = _rank(summary)
        if rank >= (self.host.best or rank):
            self.host.best = rank
            if self._is_first:
                scores = {**summary, "scenes": "validation", "decisions": self.decisions}
                self._policy, self._policy_is_waiting = (jax.device_get(params), scores), True
                self._write_policy()
        low, high = summary["success_ci95"]
        kept = {k: v for k, v in summary.items() if isinstance(v, float)}
        kept |= {"success_low": low, "success_high": high}
        return {f"evaluation/{name}": value for name, value in kept.items()}

    def snapshot(self) -> HostState:
        """What the host knows now, to be saved later."""
        return dataclasses.replace(self.host, recent=list(self.host.recent), best=list(self.host.best))

    def write(self, row: dict[str, float]) -> None:
        """Writes a row to every logger."""
        self._require_ours()
        if self._writer:
            self._writer.write(self.decisions, row)

    def save(self, state: Any, host: HostState | None = None) -> None:
        """Writes a checkpoint: of now, or of when the host's state was ``host``."""
        self._require_ours()
        self._put_back()
        self._write_policy()
        host = host or self.host
        data = dataclasses.asdict(host)
        if self._policy_is_waiting:  # who goes on from here must not wait for a better one than it
            data["best"] = self._best_on_disk
        write = functools.partial(self._checkpoints.save, host.updates, state, data)
        if not self._is_alone:
            write()  # the others wait for this process: what fails here fails everywhere
            self.num_saved = self._checkpoints.latest
        elif self._try(f"the checkpoint of update {host.updates}", write):
            self.num_saved = self._checkpoints.latest

    def not_on_disk(self, updates: int | None) -> list[str]:
        """What could not be written in spite of all tries, after one more; ``updates``: of the expected checkpoint."""
        missing = [] if self.num_saved == updates else [f"the checkpoint of update {updates}"]
        self._write_policy()
        missing += ["the best policy"] if self._policy_is_waiting else []
        lines = self._writer.catch_up() if self._writer else 0
        return missing + ([f"{lines} lines of metrics.jsonl"] if lines else [])

    def _write_policy(self) -> None:
        if not self._writing_policy.acquire(timeout=PATIENCE_S):  # the thread that ends a late run may come here too
            return
        try:
            if self._policy is None or not self._policy_is_waiting:
                return
            if self._try("the best policy", functools.partial(self._replace_policy, *self._policy)):
                self._policy_is_waiting, self._best_on_disk = False, _rank(self._policy[1])
        finally:
            self._writing_policy.release()

    def _replace_policy(self, params: Params, scores: dict[str, Any]) -> None:
        (self.folder / "eval.json").unlink(missing_ok=True)  # of a run that was over, and of its policy
        save_policy(self.folder / "policy", self.config, params, scores)

    def _require_ours(self) -> None:
        """Nothing is written into another run's folder; where it cannot be looked at, writing says why.

        Raises:
            ConfigError: where the folder was removed, and another run stands in its place.
        """
        if self._lock is None:
            return
        with contextlib.suppress(OSError):
            if not self._lock.is_same() and not self._holds_our_settings():
                raise ConfigError(
                    f"run = {str(self.folder)!r}: was removed while it trained, and another run stands there now; "
                    "nothing more is written"
                )

    def _holds_our_settings(self) -> bool:
        """Whether the folder is that of this run, moved or restored, or an empty one."""
        file = self.folder / "config.json"
        if not file.exists():
            return True
        try:
            _require_same_run(self.config, flatten(to_dict(TrainConfig())) | flatten(read_json(file)), self.folder)
        except (ValueError, TypeError, AttributeError):
            return False
        return True

    def _put_back(self) -> None:
        """Writes the settings and the best policy again where somebody removed the run's folder."""
        if not self._is_first:
            return
        if not _is_there(self.folder / "config.json"):
            self._try("config.json", functools.partial(_write_settings, self.folder, self.config))
        if self._policy is not None and not _is_there(self.folder / "policy" / "policy.json"):
            self._policy_is_waiting = True

    def _try(self, what: str, write: Callable[[], None]) -> bool:
        try:
            write()
        except Exception as error:  # orbax and the file system raise many kinds
            kind = what.split(" of ")[0]
            if kind not in self._failing:
                kept = f"; the last good checkpoint is that of update {self.num_saved}" if self.num_saved else ""
                self.say(f"warning: {what} cannot be written ({one_line(error)}); the run goes on{kept}")
            self._failing.add(kind)
            return False
        self._failing.discard(what.split(" of ")[0])
        return True

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
        ConfigError: where a folder is in use or cannot be written, or a logger cannot be opened.
    """
    opened: list[Run] = []
    try:
        for settings in config.runs:
            opened.append(_open_run(settings, processes, say))
    except ConfigError:
        for run in opened:
            run.close()
        for settings in config.runs:
            folder = Path(settings.runs_dir) / settings.run_name
            if processes.is_first and not config.resume and not is_being_trained(folder):
                shutil.rmtree(folder)
        raise
    return opened


def _open_run(config: TrainConfig, processes: Processes, say: Callable[[str], None]) -> Run:
    try:
        return Run(config, processes, say)
    except OSError as error:
        raise _cannot_be_written(Path(config.runs_dir) / config.run_name, error) from None


def _cannot_be_written(run_dir: Path, error: OSError) -> ConfigError:
    place = f"{error.filename}: " if error.filename else ""
    return ConfigError(f"run = {str(run_dir)!r}: cannot be written ({place}{error.strerror or error})")


def open_run_dir(config: TrainConfig) -> Path:
    """Makes the run's folder and writes the resolved config, or checks that it can be resumed.

    Raises:
        ConfigError: where it exists already and ``resume`` is off, or has nothing to resume, or was another run.
    """
    run_dir = Path(config.runs_dir) / config.run_name
    config_file = run_dir / "config.json"
    if not config.resume:
        taken = ConfigError(f"run = {str(run_dir)!r}: exists already; go on with --resume, or choose another --run")
        if _holds_something(run_dir):
            raise taken
        try:
            run_dir.mkdir(parents=True, exist_ok=True)
            with contextlib.closing(RunLock(run_dir)):  # two may have come at once, and seen nothing there
                if _holds_something(run_dir):
                    raise taken
                _write_settings(run_dir, config)
        except OSError as error:
            raise _cannot_be_written(run_dir, error) from None
        return run_dir
    if not config_file.is_file():
        raise ConfigError(f"run = {str(run_dir)!r}: has no checkpoint to resume; leave --resume out")
    try:
        before = read_json(config_file)
        then = flatten(to_dict(TrainConfig())) | flatten(before)
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise ConfigError(f"{config_file}: cannot be read ({one_line(error)})") from None
    _require_same_run(config, then, run_dir)
    return run_dir


def _holds_something(run_dir: Path) -> bool:
    """Whether there is more in a folder than what a run leaves that ended before it wrote its settings."""
    if not run_dir.exists():
        return False
    if not run_dir.is_dir():
        return True
    return any(path.name not in OURS and path.suffix != ".partial" for path in run_dir.iterdir())


def _write_settings(run_dir: Path, config: TrainConfig) -> None:
    run_dir.mkdir(parents=True, exist_ok=True)
    text = json.dumps(to_dict(config), indent=2) + "\n"
    replace_file(run_dir / "config.json", lambda file: file.write(text.encode()))


def _require_same_run(config: TrainConfig, then: dict[str, Any], run_dir: Path) -> None:
    """Only the number of steps and bookkeeping may change when a run goes on. What old runs do not say is neutral."""
    now = flatten(json.loads(json.dumps(to_dict(config))))
    for name, value in now.items():
        if name not in FREE_ON_RESUME and value != then.get(name):
            raise ConfigError(f"{name} = {value!r}: should be {then.get(name)!r}, as when {run_dir} was started")


def require_policy_of(run_dir: Path, trained: TrainConfig) -> None:
    """Checks that the policy in a run's folder was trained with the run's settings, where those can be read.

    Raises:
        ConfigError: where it is another run's.
    """
    try:
        then = flatten(to_dict(TrainConfig())) | flatten(read_json(run_dir / "config.json"))
    except (OSError, ValueError, TypeError, AttributeError):
        return
    try:
        _require_same_run(trained, then | {"start_from": trained.start_from}, run_dir)  # a policy names no folders
    except ConfigError as error:
        raise ConfigError(f"{run_dir / 'policy' / 'policy.json'}: is another run's policy ({error})") from None


def _rank(scores: dict[str, Any]) -> list[float]:
    """What the best policy has most of: successes, then few collisions, then short paths."""
    return [scores["success"], -scores["collision"], scores["spl"]]


def _is_there(path: Path) -> bool:
    """Whether a file is there; it is not where the file system does not say."""
    try:
        return path.exists()
    except OSError:
        return False


def _finished_episodes(log: EpisodeLog) -> list[list[float]]:
    """(outcome, return, decisions) of the episodes that ended, in the order of time."""
    outcome, returns, lengths = jax.device_get((log.outcome, log.episode_return, log.num_decisions))
    ended = np.nonzero(outcome != Outcome.RUNNING)
    return [[int(outcome[i]), float(returns[i]), int(lengths[i])] for i in zip(*ended, strict=True)]


def _row(metrics: dict[str, Any], log: EpisodeLog, recent) -> dict[str, float]:
    """What one update has to say, by the names that the log file uses."""
    row = {f"ppo/{name}": float(value) for name, value in metrics.items()}
    for name, term in log.terms.by_name().items():
        row[f"reward/{name}"] = float(np.mean(jax.device_get(term)))
    if recent:
        episodes = np.array(recent)
        for kind in OUTCOMES:
            row[f"episode/{kind.name.lower()}"] = float(np.mean(episodes[:, 0] == kind))
        row["episode/return"] = float(np.mean(episodes[:, 1]))
        row["episode/decisions"] = float(np.mean(episodes[:, 2]))
    return row

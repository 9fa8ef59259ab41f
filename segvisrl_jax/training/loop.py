"""``train(config)``: rollouts, updates, held-out evaluation, checkpoints, signals; what a run leaves behind."""

import collections
import contextlib
import dataclasses
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import struct
from rich.console import Console

from segvisrl_jax.agent.networks import Network, Params, make_network
from segvisrl_jax.agent.ppo import Learner, LearnerState, make_learner
from segvisrl_jax.config import (
    ConditionsConfig,
    ConfigError,
    EnvConfig,
    TrainConfig,
    flatten,
    replace_fields,
    require,
    to_dict,
)
from segvisrl_jax.env.rover_env import RoverEnv, observation_shape
from segvisrl_jax.env.wrappers import VALIDATION_STREAM, BatchEnv, scene_stream
from segvisrl_jax.training.checkpoint import Checkpoints, load_policy, save_policy
from segvisrl_jax.training.devices import ACTOR, BY_ENV, BY_TIME_AND_ENV, EVERYWHERE, TRAJECTORY, Devices
from segvisrl_jax.training.evaluation import Evaluator, summarize
from segvisrl_jax.training.loggers import Logger
from segvisrl_jax.training.metrics import MetricsWriter, ProgressDisplay
from segvisrl_jax.training.policy import Policy, network_policy
from segvisrl_jax.training.processes import Processes, join
from segvisrl_jax.training.rollout import ActorState, EpisodeLog, start_acting, unroll
from segvisrl_jax.training.stop_signals import StopSignals
from segvisrl_jax.training.trackers import open_trackers, require_installed
from segvisrl_jax.types import Outcome

RECENT_EPISODES = 200  # what the progress bar's shares are taken over
FREE_ON_RESUME = (
    "steps", "resume", "runs_dir", "run", "evaluation", "checkpoint_every_updates", "preset", "loggers",
    "num_devices", "coordinator", "num_processes", "process_id",
)  # fmt: skip
OUTCOMES = (Outcome.SUCCESS, Outcome.COLLISION, Outcome.FALL, Outcome.TIMEOUT)


@struct.dataclass
class TrainingState:
    """Everything on the device that the next update depends on."""

    learner: LearnerState
    actor: ActorState
    update_key: jax.Array


@dataclasses.dataclass
class HostState:
    """Everything on the host that goes into a checkpoint, as JSON data."""

    updates: int = 0
    seconds: float = 0.0  # spent training, over all sessions of the run
    recent: list[list[float]] = dataclasses.field(default_factory=list)  # outcome, return, decisions
    best: list[float] = dataclasses.field(default_factory=list)  # rank of the best policy so far


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """Where a run is and how it ended."""

    run_dir: Path
    finished: bool  # False where a signal ended it early
    decisions: int
    seconds: float


class Trainer:
    """One run: builds every part from the config, then updates until done or told to stop."""

    def __init__(self, config: TrainConfig):
        self.config = config
        env = RoverEnv(config.env)
        self.devices = Devices(config.num_devices, config.num_processes)
        shard = self.devices.shard
        self.network: Network = make_network(config.arch, config.network, env.observation_shape)
        draw = jax.vmap(jax.vmap(env.observe)) if config.ppo.redraw_observations else None
        self.learner: Learner = make_learner(self.network, config.ppo, config.num_updates, draw=draw, shard=shard)
        self.batch = BatchEnv(env, config.ppo.num_envs // shard.count)
        self.policy: Policy = network_policy(self.network, config.arch)
        self.evaluator = Evaluator(RoverEnv(validation_env(config)), self.policy, config.evaluation.num_slots)
        self._lay_out = self.devices.lay_out(lambda key: key, EVERYWHERE)
        self._split = self.devices.lay_out(lambda key: tuple(jax.random.split(key)), EVERYWHERE)
        self._init = self.devices.lay_out(self.learner.init, EVERYWHERE)
        self._begin = self.devices.lay_out(lambda key: start_acting(key, config.ppo.num_envs, env, self.network), ACTOR)
        acted = (ACTOR, TRAJECTORY, BY_ENV, BY_TIME_AND_ENV)
        self._unroll = self.devices.share(jax.jit(self._unroll_batch), (EVERYWHERE, ACTOR), acted)
        given = (EVERYWHERE, TRAJECTORY, BY_ENV, EVERYWHERE)
        self._learn = self.devices.share(self.learner.update, given, (EVERYWHERE, EVERYWHERE))

    def start(self, params: Params | None = None) -> TrainingState:
        """The state before the first update, with random weights where none are given."""
        params_key, act_key, update_key = jax.random.split(jax.random.key(self.config.seed), 3)
        learner = self._init(params_key)
        if params is not None:
            laid_out = jax.tree.map(lambda new, old: jax.device_put(new, old.sharding), params, learner.params)
            learner = dataclasses.replace(learner, params=laid_out)
        return TrainingState(learner, self._begin(act_key), self._lay_out(update_key))

    def update(self, state: TrainingState) -> tuple[TrainingState, dict[str, Any], EpisodeLog]:
        """One rollout and one learning update; the log as NumPy arrays."""
        next_key, key = self._split(state.update_key)
        actor, trajectory, last_value, log = self.act(state)
        learner, metrics = self._learn(state.learner, trajectory, last_value, key)
        return TrainingState(learner, actor, next_key), metrics, self.devices.gather(log)

    def act(self, state: TrainingState):
        """One rollout: see ``rollout.unroll``."""
        return self._unroll(state.learner, state.actor)

    def evaluate(self, params: Any) -> dict[str, Any]:
        """The current policy on the validation scenes."""
        stream = scene_stream(self.config.seed, VALIDATION_STREAM)
        finished = self.evaluator.run(self.devices.on_one(params), stream, self.config.evaluation.episodes)
        return summarize(finished, self.evaluator.env)

    def _unroll_batch(self, learner: LearnerState, actor: ActorState):
        return unroll(learner.params, actor, self.batch, self.network, self.config.ppo, self.devices.shard)


def held_out_env(config: EnvConfig) -> EnvConfig:
    """The same world with the paper's start and goals, ``num_rocks`` rocks, no margin and neutral conditions.

    So it is whatever training is made of.
    """
    neutral = {"random_start_yaw_share": 0.0, "random_num_rocks_max": 0, "collision_margin_m": 0.0}
    return replace_fields(config, conditions=ConditionsConfig(), **neutral)


def validation_env(config: TrainConfig) -> EnvConfig:
    """The held-out world with the validation scenes' number of rocks."""
    env, rocks = held_out_env(config.env), config.evaluation.rocks
    return env if rocks is None else replace_fields(env, num_rocks=rocks)


def train(config: TrainConfig, say=print) -> TrainResult:
    """Runs one training to its end, or to the first SIGINT or SIGTERM, which saves and returns.

    Writes config.json, metrics.jsonl, TensorBoard events, checkpoints/ and policy/ (the best one) to the run folder.
    Where it is one of several processes, it meets the others first, and ends with all of them; where one is lost,
    this process ends at once (exit code 3).

    Raises:
        ConfigError: where the run folder exists and is not to be resumed, or cannot be; where the policy to start from
            is of another architecture, or sees something else; where a logger is not installed or cannot be opened.
    """
    processes = join(config)
    first_params = _params_to_start_from(config)
    require_installed(config.loggers)
    run_dir = Path(config.runs_dir) / config.run_name
    processes.on_first(lambda: open_run_dir(config))
    result = _train_in(run_dir, config, processes, first_params, say if processes.is_first else _say_nothing)
    processes.leave()
    return result


def _train_in(
    run_dir: Path, config: TrainConfig, processes: Processes, first_params: Params | None, say: Callable[[str], None]
) -> TrainResult:
    with contextlib.ExitStack() as stack:
        writer = None
        if processes.is_first:
            trackers = _open_trackers(config, run_dir)
            writer = stack.enter_context(MetricsWriter(run_dir, trackers=trackers, say=say))
        trainer = Trainer(config)
        checkpoints = Checkpoints(run_dir)
        state, host = trainer.start(first_params), HostState()
        if config.resume:
            state, data = checkpoints.restore_latest(state)
            host = HostState(**data)
            say(f"going on from update {host.updates} of {config.num_updates}")
        try:
            with StopSignals() as stop:
                if writer:
                    writer.resume_at(host.updates * config.ppo.decisions_per_update)
                session = _Session(config, run_dir, trainer, checkpoints, writer, stop, processes)
                state = session.drive(state, host)
        except jax.errors.JaxRuntimeError as error:
            if processes.count > 1:
                processes.give_up(error, f"{run_dir} has its last checkpoint: start all processes again with --resume")
            raise
        finally:
            checkpoints.close()
    done = host.updates * config.ppo.decisions_per_update
    return TrainResult(run_dir, host.updates >= config.num_updates, done, host.seconds)


def _say_nothing(line: str) -> None:
    """Of the processes beside the first one."""


def _open_trackers(config: TrainConfig, run_dir: Path) -> dict[str, Logger]:
    """What the settings name; where that fails, a new run leaves no folder behind that would be in the way."""
    try:
        return open_trackers(config, run_dir)
    except ConfigError:
        if not config.resume:
            shutil.rmtree(run_dir)
        raise


def _params_to_start_from(config: TrainConfig) -> Params | None:
    if not config.start_from or config.resume:
        return None
    source, params, _ = load_policy(Path(config.start_from))
    for name, ours, theirs in (
        ("arch", config.arch, source.arch),
        ("network", config.network, source.network),
        ("observations", observation_shape(config.env), observation_shape(source.env)),
    ):
        require(ours == theirs, "start_from", config.start_from, f"a policy whose {name} is {ours}, not {theirs}")
    return params


@dataclasses.dataclass
class _Session:
    """One sitting of a run."""

    config: TrainConfig
    run_dir: Path
    trainer: Trainer
    checkpoints: Checkpoints
    writer: MetricsWriter | None  # of the first process
    stop: StopSignals
    processes: Processes

    def drive(self, state: TrainingState, host: HostState) -> TrainingState:
        """Updates until the run's end or a signal; the last state is always saved."""
        config = self.config
        recent = collections.deque(host.recent, maxlen=RECENT_EPISODES)
        every = -(-config.evaluation.every_decisions // config.ppo.decisions_per_update)
        total = config.num_updates * config.ppo.decisions_per_update
        console = None if self.processes.is_first else Console(quiet=True)
        with ProgressDisplay(total, self._decisions(host), config.run_name, console) as display:
            while host.updates < config.num_updates and not self.processes.any(self.stop.requested):
                began = time.monotonic()
                state, metrics, log = self.trainer.update(state)
                recent.extend(_finished_episodes(log))
                host.updates += 1
                row = _row(jax.device_get(metrics), log, recent)
                host.seconds += time.monotonic() - began
                row |= self._speed(host, time.monotonic() - began)
                if host.updates % every == 0 or host.updates == config.num_updates:
                    row |= self._evaluate(state, host)
                self._report(row, host, display)
                host.recent = [list(episode) for episode in recent]
                if host.updates % config.checkpoint_every_updates == 0:
                    self._save(state, host)
        self._save(state, host)
        return state

    def _speed(self, host: HostState, seconds: float) -> dict[str, float]:
        decisions = self.config.ppo.decisions_per_update
        return {"time/seconds": host.seconds, "time/decisions_per_second": decisions / seconds}

    def _evaluate(self, state: TrainingState, host: HostState) -> dict[str, float]:
        summary = self.trainer.evaluate(state.learner.params)
        rank = [summary["success"], -summary["collision"], summary["spl"]]
        if rank >= (host.best or rank):
            host.best = rank
            scores = {**summary, "scenes": "validation", "decisions": self._decisions(host)}
            if self.processes.is_first:
                save_policy(self.run_dir / "policy", self.config, state.learner.params, scores)
        low, high = summary.pop("success_ci95")
        kept = {k: v for k, v in summary.items() if isinstance(v, float)}
        kept |= {"success_low": low, "success_high": high}
        return {f"evaluation/{name}": value for name, value in kept.items()}

    def _report(self, row: dict[str, float], host: HostState, display: ProgressDisplay) -> None:
        decisions = self._decisions(host)
        if self.writer:
            self.writer.write(decisions, row)
        display.update(decisions, row)

    def _save(self, state: TrainingState, host: HostState) -> None:
        self.checkpoints.save(host.updates, state, dataclasses.asdict(host))

    def _decisions(self, host: HostState) -> int:
        return host.updates * self.config.ppo.decisions_per_update


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

"""``train(config)``: rollouts, updates, held-out evaluation, checkpoints, signals; what a run leaves behind."""

import contextlib
import dataclasses
import functools
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from rich.console import Console

from segvisrl_jax.agent.networks import Network, Params, make_network
from segvisrl_jax.agent.ppo import Learner, LearnerState, make_learner
from segvisrl_jax.agent.shard import Shard
from segvisrl_jax.config import ConditionsConfig, ConfigError, EnvConfig, TrainConfig, replace_fields, require
from segvisrl_jax.cpu import make_callbacks_safe
from segvisrl_jax.env.rover_env import RoverEnv, observation_shape
from segvisrl_jax.env.wrappers import VALIDATION_STREAM, BatchEnv, scene_stream
from segvisrl_jax.training.checkpoint import load_policy
from segvisrl_jax.training.cores import Cores, acting_cores
from segvisrl_jax.training.devices import ACTOR, BY_ENV, BY_TIME_AND_ENV, EVERYWHERE, TRAJECTORY, Devices
from segvisrl_jax.training.evaluation import Evaluator, summarize
from segvisrl_jax.training.metrics import ProgressDisplay, output_may_fail
from segvisrl_jax.training.policy import Policy, network_policy
from segvisrl_jax.training.processes import Processes, join
from segvisrl_jax.training.rollout import ActorState, EpisodeLog, start_acting, unroll
from segvisrl_jax.training.run import HostState, Run, open_run_dirs, open_runs
from segvisrl_jax.training.stop_signals import StopSignals
from segvisrl_jax.training.trackers import require_installed
from segvisrl_jax.vision.renderer import InGraphRenderer


@struct.dataclass
class TrainingState:
    """Everything on the device that the next update depends on."""

    learner: LearnerState
    actor: ActorState
    update_key: jax.Array


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """Where runs are and how they ended."""

    run_dirs: tuple[Path, ...]  # one for each seed
    finished: bool  # False where a signal ended it early
    told_to_stop: bool  # by a signal, which may have come when nothing was left to do
    not_on_disk: tuple[str, ...]  # what could not be written; empty unless a disk or folder failed
    decisions: int  # that are saved

    @property
    def run_dir(self) -> Path:
        """The folder of the first seed."""
        return self.run_dirs[0]


class Trainer:
    """Builds every part from the config, and updates: one run, or K of them at once (``num_seeds``).

    Of K runs, everything in the state, metrics and log is (K, ...).
    """

    def __init__(self, config: TrainConfig):
        self.config = config
        env = RoverEnv(config.env)
        self.devices = Devices(config.num_devices, config.num_processes)
        shard = self.devices.shard
        self.network: Network = make_network(config.arch, config.network, env.observation_shape)
        draw = jax.vmap(jax.vmap(env.observe)) if config.ppo.redraw_observations else None
        self.learner: Learner = make_learner(self.network, config.ppo, config.num_updates, draw=draw, shard=shard)
        on_host = self.learner.execution == "host"
        self.cores = Cores(acting_cores(config.ppo.num_envs) if on_host else 1)
        self.batch = BatchEnv(env, config.ppo.num_envs // shard.count // self.cores.count)
        self.policy: Policy = network_policy(self.network, config.arch)
        held_out = RoverEnv(validation_env(config))
        self.evaluator = Evaluator(held_out, self.policy, config.evaluation.num_slots, self.devices)
        self._lay_out = self.devices.lay_out(lambda key: key, EVERYWHERE)
        self._split = self.devices.lay_out(lambda key: tuple(jax.random.split(key)), EVERYWHERE)
        self._init = self.devices.lay_out(self.learner.init, EVERYWHERE)
        self._begin = self.devices.lay_out(lambda key: start_acting(key, config.ppo.num_envs, env, self.network), ACTOR)
        acting, acted = (EVERYWHERE, ACTOR), (ACTOR, TRAJECTORY, BY_ENV, BY_TIME_AND_ENV)
        if self.cores.count > 1:
            self._unroll = self.cores.share(self._unroll_batch, acting, acted)
        else:
            unroll_batch = functools.partial(self._unroll_batch, shard)
            self._unroll = self.devices.share(jax.jit(unroll_batch), acting, acted)
        given = (EVERYWHERE, TRAJECTORY, BY_ENV, EVERYWHERE)
        self._learn = self.devices.share(self.learner.update, given, (EVERYWHERE, EVERYWHERE))
        if config.num_seeds > 1:
            self._train_seeds_together()

    def _train_seeds_together(self) -> None:
        """Has every program do its work for all seeds; what it takes and gives is (K, ...).

        One program for all where the learner is one; else one seed after the other: it is Python that drives the
        learner then, and every core already.
        """
        for name in ("_lay_out", "_split", "_init", "_begin", "_unroll", "_learn"):
            work = getattr(self, name)
            together = jax.jit(jax.vmap(work)) if self.learner.execution == "fused" else self._in_turn(work)
            setattr(self, name, together)

    def _in_turn(self, work: Callable[..., Any]) -> Callable[..., Any]:
        seeds = range(self.config.num_seeds)
        return lambda *given: self.of_seeds([work(*self.of_seed(given, i)) for i in seeds])

    def of_seed(self, tree: Any, index: int) -> Any:
        """One seed's part of what all have; all of it where there is one."""
        return tree if self.config.num_seeds == 1 else jax.tree.map(lambda leaf: leaf[index], tree)

    def of_seeds(self, trees: Sequence[Any]) -> Any:
        """The inverse of ``of_seed``."""
        return trees[0] if len(trees) == 1 else jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)

    def start(self, params: Params | None = None) -> TrainingState:
        """The state before the first update, with random weights where none are given."""
        drawn = [jax.random.split(jax.random.key(run.seed), 3) for run in self.config.runs]
        params_key, act_key, update_key = self.of_seeds([tuple(keys) for keys in drawn])
        learner = self._init(params_key)
        if params is not None:
            given = self.of_seeds([params] * self.config.num_seeds)
            laid_out = jax.tree.map(lambda new, old: jax.device_put(new, old.sharding), given, learner.params)
            learner = dataclasses.replace(learner, params=laid_out)
        return TrainingState(learner, self._begin(act_key), self._lay_out(update_key))

    def update(self, state: TrainingState) -> tuple[TrainingState, dict[str, Any], EpisodeLog]:
        """One rollout and one learning update; the log as NumPy arrays.

        The programs are queued one behind the other, so that a device does not wait between them. None is given its
        buffers to write in: a late stop saves the state from before (``_Session.end_late``), and nothing else is as
        large as something that comes out. It would spare 41 MB at 192 x 108, of the learner.
        """
        next_key, key = self._split(state.update_key)
        actor, trajectory, last_value, log = self.act(state)
        learner, metrics = self._learn(state.learner, trajectory, last_value, key)
        return TrainingState(learner, actor, next_key), metrics, self.devices.gather(log)

    def act(self, state: TrainingState):
        """One rollout: see ``rollout.unroll``."""
        return self._unroll(state.learner, state.actor)

    def evaluate(self, params: Any, seed: int) -> dict[str, Any]:
        """A policy on the validation scenes of a seed."""
        stream = scene_stream(seed, VALIDATION_STREAM)
        finished = self.evaluator.run(params, stream, self.config.evaluation.episodes)
        return summarize(finished, self.evaluator.env)

    def _unroll_batch(self, shard: Shard, learner: LearnerState, actor: ActorState):
        return unroll(learner.params, actor, self.batch, self.network, self.config.ppo, shard)


def held_out_env(config: EnvConfig) -> EnvConfig:
    """The same world without random headings, with ``num_rocks`` rocks, no margin and neutral conditions.

    So it is whatever training is made of.
    """
    neutral = {"random_start_yaw_share": 0.0, "random_num_rocks_max": 0, "collision_margin_m": 0.0}
    return replace_fields(config, conditions=ConditionsConfig(), **neutral)


def validation_env(config: TrainConfig) -> EnvConfig:
    """The held-out world with the validation scenes' number of rocks."""
    env, rocks = held_out_env(config.env), config.evaluation.rocks
    return env if rocks is None else replace_fields(env, num_rocks=rocks)


class DivergedError(RuntimeError):
    """Losses or gradients are not finite again and again."""


def train(config: TrainConfig, say=print, when_late: Callable[[str], object] | None = None) -> TrainResult:
    """Runs one training, or one of every seed, to its end, or to the first SIGINT, SIGTERM or SIGHUP.

    A signal saves and returns.

    Where ``when_late`` is given and an update takes longer than ``stop_signals.GRACE_S`` after the signal, the state
    before that update is saved in its place, and ``when_late`` is called, in another thread, with a line that says what
    has been saved; so it is at a second signal, at once. It has to end the process.

    Writes config.json, metrics.jsonl, TensorBoard events, checkpoints/ and policy/ (the best one) to the run folder.
    Where it is one of several processes, it meets the others first, and ends with all of them; where one is lost,
    this process ends at once (exit code 3), and within ``processes.ALIKE_S`` where it alone fails (exit code 1).

    Raises:
        ConfigError: where the run folder exists and is not to be resumed, or cannot be; where the policy to start from
            is of another architecture, or sees something else; where a logger is not installed or cannot be opened;
            where this machine lacks what the settings ask for.
        DivergedError: where a loss or gradient was not finite in each of ``max_bad_updates`` updates in a row.
    """
    say = functools.partial(_tell, say)
    make_callbacks_safe()  # before anything starts JAX's backends
    processes = join(config)
    processes.together(lambda: require_installed(config.loggers))
    first_params = None if config.resume else processes.together(lambda: _params_to_start_from(config))
    trainer = processes.together(lambda: _trainer_that_can_see(config))  # refused before anything is made
    processes.on_first(lambda: open_run_dirs(config))
    go_on = f"{Path(config.runs_dir) / config.runs[0].run_name} has its last checkpoint: start all again with --resume"
    with contextlib.ExitStack() as stack, processes.giving_up(go_on):
        stack.callback(processes.leave)
        runs = open_runs(config, processes, say if processes.is_first else _say_nothing)
        for run in runs:
            stack.callback(run.close)
        session = _Session(trainer, runs, processes)
        late = functools.partial(session.end_late, when_late) if when_late and processes.count == 1 else None
        with StopSignals(late=late) as stop:
            finished = session.drive(stop, first_params)
        missing = tuple(f"{run.folder}: {what}" for run in runs for what in run.not_on_disk(session.num_to_be_saved))
    decisions = (runs[0].num_saved or 0) * config.ppo.decisions_per_update
    return TrainResult(tuple(run.folder for run in runs), finished, stop.requested, missing, decisions)


def _tell(say: Callable[[str], object], line: str) -> None:
    """Says a line; a training does not end because nobody can hear it."""
    with output_may_fail():
        say(line)


def _say_nothing(line: str) -> None:
    """Of the processes beside the first one."""


def _trainer_that_can_see(config: TrainConfig) -> Trainer:
    """Opens what its renderer draws with: OpenGL, which may be missing, is opened where drawing is first traced."""
    trainer = Trainer(config)
    env = trainer.evaluator.env
    if env.renderer is not None and not isinstance(env.renderer, InGraphRenderer):
        jax.eval_shape(lambda: env.observe(env.initial_state(jax.random.key(config.seed))))
    return trainer


# Settings that may differ from those of given weights, at any values: of random weights, and of training alone.
_FREE_OF_GIVEN_WEIGHTS: dict[str, Any] = {"initial_std": 1.0, "min_std": 0.01, "initial_turn": 0.0}


def _params_to_start_from(config: TrainConfig) -> Params | None:
    if not config.start_from:
        return None
    source, params, _ = load_policy(Path(config.start_from))
    for name, ours, theirs in (
        ("arch", config.arch, source.arch),
        ("network", *(dataclasses.replace(one.network, **_FREE_OF_GIVEN_WEIGHTS) for one in (config, source))),
        ("observations", observation_shape(config.env), observation_shape(source.env)),
    ):
        require(ours == theirs, "start_from", config.start_from, f"a policy whose {name} is {ours}, not {theirs}")
    return params


class _Session:
    """One sitting of the runs that a trainer trains."""

    def __init__(self, trainer: Trainer, runs: Sequence[Run], processes: Processes) -> None:
        self.trainer, self.config, self.runs, self.processes = trainer, trainer.config, runs, processes
        self._saving = threading.Lock()
        self._whole: tuple[TrainingState, list[HostState]] | None = None  # after the last update that is written down
        self._bad_updates = 0  # in a row
        self.num_to_be_saved: int | None = None  # updates behind the checkpoint that the last save was to write

    def drive(self, stop: StopSignals, first_params: Params | None) -> bool:
        """Updates until the end or a signal, and saves; whether it is the end."""
        config = self.config
        state = self._start(first_params)
        self.num_to_be_saved = self.runs[0].num_saved
        for run in self.runs:
            run.begin()
        every = -(-config.evaluation.every_decisions // config.ppo.decisions_per_update)
        total = config.num_updates * config.ppo.decisions_per_update
        console = None if self.processes.is_first else Console(quiet=True)
        with ProgressDisplay(total, self._decisions, self._name, console) as display:
            while self._updates < config.num_updates and not self.processes.any(stop.requested):
                self._whole = state, [run.snapshot() for run in self.runs]
                state, rows = self._update(state)
                self._require_finite(rows)
                if self._updates % every == 0 or self._updates == config.num_updates:
                    self._evaluate(state, rows)
                for run, row in zip(self.runs, rows, strict=True):
                    run.write(row)
                display.update(self._decisions, _median(rows))
                if self._updates % config.checkpoint_every_updates == 0 and not self._bad_updates:
                    self._save(state)
            finished = self._updates >= config.num_updates
            if finished or not self._bad_updates:
                self._save(state)
        return finished

    def _start(self, first_params: Params | None) -> TrainingState:
        if not self.config.resume:
            return self.trainer.start(first_params)
        if len({run.num_saved for run in self.runs}) > 1:
            self._go_back_together()
        if self.runs[0].num_saved is None:
            for run in self.runs:
                run.require_nothing_lost()
            self.runs[0].say("nothing was saved yet: starting at the beginning")
            return self.trainer.start(_params_to_start_from(self.config))
        state = self.trainer.start()
        return self.trainer.of_seeds([run.restore(self.trainer.of_seed(state, i)) for i, run in enumerate(self.runs)])

    def _go_back_together(self) -> None:
        """Leaves every seed with the newest checkpoint that all have: one that is killed has written some and not all.

        Raises:
            ConfigError: where there is none: some went on by themselves, or one could not write for long.
        """
        common = set.intersection(*(run.can_go_on_from() for run in self.runs))
        reached = [run.num_saved or 0 for run in self.runs]
        should = f"1, for each run by itself: they have made {reached} updates"
        require(bool(common), "num_seeds", len(self.runs), should)
        for run in self.runs:
            run.go_back_to(max(common))

    def end_late(self, end: Callable[[str], object], at_once: bool) -> None:
        """In the watching thread: saves the state before the update that takes too long, and ends the process."""
        with contextlib.nullcontext() if at_once else self._saving:  # what is being written is whole or unfinished
            if self._whole is not None and not at_once and not self._bad_updates:
                state, hosts = self._whole
                for i, (run, host) in enumerate(zip(self.runs, hosts, strict=True)):
                    with contextlib.suppress(ConfigError):  # the folder is another run's now
                        run.save(self.trainer.of_seed(state, i), host)
            saved = self.runs[0].num_saved
            decisions = (saved or 0) * self.config.ppo.decisions_per_update
            end(f"Stopped at once; saved are {decisions:,} decisions." if saved else "Stopped before the first save.")

    def _require_finite(self, rows: Sequence[dict[str, float]]) -> None:
        """Stops a run that learns nothing any more, with the last good checkpoint.

        Raises:
            DivergedError: after ``max_bad_updates`` updates in a row in which a gradient step was skipped.
        """
        is_bad = any(row["ppo/skipped_steps"] > 0 for row in rows)
        self._bad_updates = self._bad_updates + 1 if is_bad else 0
        if self._bad_updates < self.config.max_bad_updates:
            return
        saved = self.runs[0].num_saved
        kept = f"the checkpoint of update {saved} is from before" if saved else "nothing was saved before"
        raise DivergedError(
            f"loss or gradient was not finite in {self._bad_updates} updates in a row; {kept}; "
            "lower ppo.learning_rate or ppo.max_gradient_norm"
        )

    def _update(self, state: TrainingState) -> tuple[TrainingState, list[dict[str, float]]]:
        began = time.monotonic()
        state, metrics, log = self.trainer.update(state)
        metrics = jax.device_get(metrics)
        seconds = time.monotonic() - began
        of_seed = self.trainer.of_seed
        told = [(of_seed(metrics, i), of_seed(log, i)) for i in range(len(self.runs))]
        return state, [run.count(numbers, ends, seconds) for run, (numbers, ends) in zip(self.runs, told, strict=True)]

    def _evaluate(self, state: TrainingState, rows: list[dict[str, float]]) -> None:
        for i, run in enumerate(self.runs):
            params = self.trainer.of_seed(state.learner.params, i)
            rows[i] |= run.judge(self.trainer.evaluate(params, run.config.seed), params)

    def _save(self, state: TrainingState) -> None:
        self.num_to_be_saved = self._updates
        with self._saving:
            for i, run in enumerate(self.runs):
                run.save(self.trainer.of_seed(state, i))

    @property
    def _updates(self) -> int:
        return self.runs[0].host.updates

    @property
    def _decisions(self) -> int:
        return self.runs[0].decisions

    @property
    def _name(self) -> str:
        name, more = self.runs[0].config.run_name, len(self.runs) - 1
        return f"{name} and {more} more" if more else name


def _median(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Over the runs, of every number that all have."""
    if len(rows) == 1:
        return rows[0]
    names = set.intersection(*(set(row) for row in rows))
    return {name: float(np.median([row[name] for row in rows])) for name in names}

"""The evaluation protocol: the same held-out scenes for every method, one number with its interval for each outcome.

Episode i of a seed is always the same scene (``fold_in`` of the stream's key with i), however many episodes are
driven at a time and whoever drives.

A policy that looks at images drives on every core of a CPU (``training.cores``), and any on all devices of a training:
each of these N parts has its share of the slots, and the first one has the episodes 0, N, 2 N, and so on.
"""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Int32, PRNGKeyArray

from segvisrl_jax.config import IMAGE_OBSERVATIONS
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import select
from segvisrl_jax.training.cores import acting_cores
from segvisrl_jax.training.devices import BY_ENV, BY_TIME_AND_ENV, EVERYWHERE, Devices
from segvisrl_jax.training.policy import Policy
from segvisrl_jax.training.shortest_path import shortest_path_m
from segvisrl_jax.training.statistics import path_ratio, spl, wilson_interval
from segvisrl_jax.types import Outcome, RoverState

DECISIONS_PER_CALL = 10  # of every slot between two looks of the host at what has finished


@struct.dataclass
class Slots:
    """S episodes that are being driven, by one part; what all devices have lies along the first axis."""

    rover: RoverState
    episode: Int32[Array, "S"]  # which episode each slot drives; beyond the last: idle
    next_episode: Int32[Array, "1"]
    is_first: Array
    carry: Any


@struct.dataclass
class Finished:
    """Episodes that ended, as NumPy arrays in the order of their numbers."""

    outcome: np.ndarray
    num_decisions: np.ndarray
    path_length_m: np.ndarray
    min_clearance_m: np.ndarray
    episode_return: np.ndarray
    goal_xy_m: np.ndarray
    rock_xy_m: np.ndarray
    start_yaw_rad: np.ndarray


@dataclasses.dataclass
class Evaluator:
    """Drives one policy over numbered scenes. Compiles once; ``run`` may be called for many parameters.

    Attributes:
        env: what is driven in.
        policy: what drives.
        num_slots: episodes that are driven at a time; rounded up to as many on each device.
        devices: of a training, on which the parameters lie; one where none are given. ``run`` is called by all
            processes then, and gives all of them the same.
    """

    env: RoverEnv
    policy: Policy
    num_slots: int
    devices: Devices = dataclasses.field(default_factory=lambda: Devices(1))

    def __post_init__(self) -> None:
        looks = self.policy.observes and self.env.config.obs in IMAGE_OBSERVATIONS
        num_devices = self.devices.shard.count
        num_cores = acting_cores(self.num_slots) if looks and num_devices == 1 else 1
        self._num_parts = num_devices * num_cores
        self._slots_of_part = -(-self.num_slots // self._num_parts)
        self._calls = np.split(np.arange(self._num_parts, dtype=np.int32), num_cores)  # the parts that each drives
        self._start = self.devices.share(jax.jit(self._begin), (EVERYWHERE, BY_ENV), BY_ENV)
        given, ended = (EVERYWHERE, BY_ENV, EVERYWHERE, EVERYWHERE, EVERYWHERE), (BY_ENV, BY_TIME_AND_ENV)
        self._drive = self.devices.share(jax.jit(self._drive_some), given, ended)

    def run(
        self,
        params: Any,
        stream: PRNGKeyArray,
        episodes: int,
        on_progress: Callable[[int], None] = lambda done: None,
    ) -> Finished:
        """Drives episodes 0 to ``episodes`` - 1 of a scene stream, each to its end."""
        number = jnp.int32(episodes)

        def drive(step: int, slots: Slots) -> tuple[Slots, dict[str, Array]]:
            return jax.block_until_ready(self._drive(params, slots, stream, number, jnp.int32(step)))

        slots = tuple(self._start(stream, parts) for parts in self._calls)
        found: dict[int, dict[str, np.ndarray]] = {}
        step = 0
        with ThreadPoolExecutor(len(self._calls), "segvisrl-driving") as pool:
            while len(found) < episodes:
                slots, ended = zip(*pool.map(functools.partial(drive, step), slots), strict=True)
                for of_call in self.devices.gather(ended):
                    _collect(of_call, found)
                on_progress(len(found))
                step += 1
        rows = [found[i] for i in range(episodes)]
        return Finished(**{name: np.stack([row[name] for row in rows]) for name in rows[0]})

    def _begin(self, stream: PRNGKeyArray, part: Int32[Array, "1"]) -> Slots:
        num_slots = self._slots_of_part
        episode = part + self._num_parts * jnp.arange(num_slots, dtype=jnp.int32)
        return Slots(
            rover=self._scenes(stream, episode),
            episode=episode,
            next_episode=part + self._num_parts * num_slots,
            is_first=jnp.ones(num_slots, jnp.float32),
            carry=self.policy.initial_carry(num_slots),
        )

    def _scenes(self, stream: PRNGKeyArray, episode: Int32[Array, "S"]) -> RoverState:
        return jax.vmap(lambda i: self.env.initial_state(jax.random.fold_in(stream, i)))(episode)

    def _drive_some(self, params, slots, stream, episodes, step) -> tuple[Slots, dict[str, Array]]:
        key = jax.random.fold_in(jax.random.fold_in(stream, episodes), step)
        keys = jax.random.split(key, DECISIONS_PER_CALL)
        decide = functools.partial(self._decide, params, stream, episodes)
        return jax.lax.scan(decide, slots, keys)

    def _decide(self, params, stream, episodes, slots: Slots, key) -> tuple[Slots, dict[str, Array]]:
        observation = jax.vmap(self.env.observe)(slots.rover) if self.policy.observes else None
        carry, action = self.policy.act(params, slots.carry, slots.rover, observation, slots.is_first, key)
        is_driving = slots.episode < episodes
        driven, _ = jax.vmap(self.env.advance)(slots.rover, action)
        rover = select(is_driving, driven, slots.rover)
        done = is_driving & (rover.outcome != Outcome.RUNNING)
        ended = _ended(slots.episode, done, rover)
        after = dataclasses.replace(slots, rover=rover, carry=carry, is_first=jnp.zeros_like(slots.is_first))
        refill = functools.partial(self._refill, stream)
        return jax.lax.cond(jnp.any(done), refill, lambda _, s: s, done, after), ended

    def _refill(self, stream: PRNGKeyArray, done: Bool[Array, "S"], slots: Slots) -> Slots:
        """Slots whose episode ended take the next numbers."""
        following = slots.next_episode + self._num_parts * (jnp.cumsum(done, dtype=jnp.int32) - 1)
        episode = jnp.where(done, following, slots.episode)
        return dataclasses.replace(
            slots,
            rover=select(done, self._scenes(stream, episode), slots.rover),
            episode=episode,
            next_episode=slots.next_episode + self._num_parts * jnp.sum(done, dtype=jnp.int32),
            is_first=done.astype(jnp.float32),
        )


def _ended(episode: Array, done: Array, rover: RoverState) -> dict[str, Array]:
    return {
        "episode": jnp.where(done, episode, -1),
        "outcome": rover.outcome,
        "num_decisions": rover.num_decisions,
        "path_length_m": rover.path_length_m,
        "min_clearance_m": rover.min_clearance_m,
        "episode_return": rover.episode_return,
        "goal_xy_m": rover.scene.goal_xy_m,
        "rock_xy_m": rover.scene.rock_xy_m,
        "start_yaw_rad": rover.scene.start_yaw_rad,
    }


def _collect(ended: dict[str, np.ndarray], found: dict[int, dict[str, np.ndarray]]) -> None:
    """Files what ended in one call under its episode's number."""
    episodes = ended.pop("episode")
    for where in zip(*np.nonzero(episodes >= 0), strict=True):
        found[int(episodes[where])] = {name: values[where] for name, values in ended.items()}


def summarize(finished: Finished, env: RoverEnv, shortest_m: np.ndarray | None = None) -> dict[str, Any]:
    """Shares of the outcomes with their intervals, and the quality of the paths.

    Args:
        finished: E episodes.
        env: what they were driven in.
        shortest_m: (E,) ``shortest_paths_m`` of the same episodes, where they are known already.

    Returns:
        success, collision, fall, timeout, unstable: shares that sum to 1, and the intervals of the first four
        (success_ci95 ..., Wilson). spl: Anderson et al. 2018, against the shortest collision-free path. path_ratio:
        driven over shortest, of successful episodes, as is mean_time_s. min_clearance_m: the least distance to a rock's
        centre over all episodes (None without rocks). mean_return. Success apart for goals that are in the camera's
        horizontal field of view at the start and for others: success_goal_in_view, success_goal_in_view_ci95,
        episodes_goal_in_view, and the same with goal_out_of_view (None where there is no such episode).
    """
    episodes = len(finished.outcome)
    summary: dict[str, Any] = {"episodes": episodes}
    for kind in Outcome:
        if kind == Outcome.RUNNING:
            continue
        count = int(np.sum(finished.outcome == kind))
        summary[kind.name.lower()] = count / episodes
        if kind != Outcome.UNSTABLE:
            summary[f"{kind.name.lower()}_ci95"] = list(wilson_interval(count, episodes))
    succeeded = finished.outcome == Outcome.SUCCESS
    shortest = shortest_paths_m(finished, env) if shortest_m is None else shortest_m
    clearance = float(np.min(finished.min_clearance_m))
    time_s = finished.num_decisions[succeeded] * env.dt
    summary["spl"] = spl(succeeded, shortest, finished.path_length_m)
    summary["path_ratio"] = path_ratio(succeeded, shortest, finished.path_length_m)
    summary["mean_time_s"] = float(np.mean(time_s)) if succeeded.any() else None
    summary["min_clearance_m"] = clearance if np.isfinite(clearance) else None
    summary["mean_return"] = float(np.mean(finished.episode_return))
    in_view = np.abs(goal_bearings_deg(finished, env)) <= env.config.camera.horizontal_fov_deg / 2
    return (
        summary | _success_of(succeeded[in_view], "goal_in_view") | _success_of(succeeded[~in_view], "goal_out_of_view")
    )


def _success_of(succeeded: np.ndarray, name: str) -> dict[str, Any]:
    """Count, share and interval of one group of episodes."""
    episodes, successes = len(succeeded), int(np.sum(succeeded))
    return {
        f"episodes_{name}": episodes,
        f"success_{name}": successes / episodes if episodes else None,
        f"success_{name}_ci95": list(wilson_interval(successes, episodes)) if episodes else None,
    }


def per_episode(finished: Finished, env: RoverEnv, shortest_m: np.ndarray) -> dict[str, list[Any]]:
    """What became of every episode, as equally long lists of JSON data, for paired tests and splits.

    Returns:
        outcome: names. num_decisions. path_length_m, shortest_path_m and min_clearance_m, rounded to millimetres,
        and goal_bearing_deg (at the start), rounded to 0.01 degrees; None where infinite, as the clearance is without
        rocks, or where physics diverged.
    """
    return {
        "outcome": [Outcome(kind).name.lower() for kind in finished.outcome],
        "num_decisions": finished.num_decisions.tolist(),
        "path_length_m": _rounded(finished.path_length_m, 3),
        "shortest_path_m": _rounded(shortest_m, 3),
        "min_clearance_m": _rounded(finished.min_clearance_m, 3),
        "goal_bearing_deg": _rounded(goal_bearings_deg(finished, env), 2),
    }


def _rounded(values: np.ndarray, digits: int) -> list[float | None]:
    return [round(value, digits) if np.isfinite(value) else None for value in values.tolist()]


def goal_bearings_deg(finished: Finished, env: RoverEnv) -> np.ndarray:
    """Angle of every episode's goal off the rover's first heading, to the left, in [-180, 180], (episodes,)."""
    offset = finished.goal_xy_m - np.asarray(env.config.scene.start_xy_m)
    angle = np.arctan2(offset[:, 1], offset[:, 0]) - finished.start_yaw_rad
    return np.degrees(np.arctan2(np.sin(angle), np.cos(angle)))


def shortest_paths_m(finished: Finished, env: RoverEnv) -> np.ndarray:
    """Length of the shortest collision-free path of every episode's scene, (episodes,)."""
    scene, task = env.config.scene, env.config.task
    pairs = zip(finished.goal_xy_m, finished.rock_xy_m, strict=True)
    start = np.asarray(scene.start_xy_m)
    half = scene.map_size_m / 2
    return np.array(
        [
            shortest_path_m(start, goal, task.goal_radius_m, rocks, task.collision_radius_m, half)
            for goal, rocks in pairs
        ]
    )

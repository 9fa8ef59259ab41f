"""Reward and outcome of one decision: pure functions of where the rover was at the judged instants.

Source: paper, section III-B. Where outcomes coincide at the same instant, the first of unstable, collision, fall,
success counts (so a collision beats a success); the time limit counts only where nothing else ended the episode.
"""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from segvisrl_jax.config import SceneConfig, TaskConfig
from segvisrl_jax.env.scene import FAR_AWAY_M
from segvisrl_jax.types import Outcome, RewardTerms, Scene


@struct.dataclass
class Track:
    """Where the rover was at the J judged instants of one decision."""

    xy_m: Float32[Array, "J 2"]
    up_z: Float32[Array, "J"]  # z component of the body's up axis: cosine of the tilt
    is_finite: Bool[Array, "J"]


@struct.dataclass
class Verdict:
    """What one decision led to."""

    outcome: Int32[Array, ""]  # an ``Outcome``
    last: Int32[Array, ""]  # the judged instant at which the decision ended: J - 1 unless the episode ended earlier
    terms: RewardTerms
    path_length_m: Float32[Array, ""]  # driven in this decision
    min_clearance_m: Float32[Array, ""]  # least distance to a rock's centre; inf without rocks


def judge(
    start_xy_m: Float32[Array, "2"],
    track: Track,
    scene: Scene,
    num_decisions: Int32[Array, ""],
    task: TaskConfig,
    rules: SceneConfig,
) -> Verdict:
    """Judges one decision.

    Args:
        start_xy_m: where the rover was before the decision, world frame.
        track: where it was at the judged instants.
        scene: goal and rocks.
        num_decisions: decisions of this episode including this one.
        task: radii, rewards, time limit.
        rules: the map.

    Returns:
        The outcome at the first judged instant at which one applies, and the reward earned up to then.
    """
    at_instant = outcome_at_instants(track, scene, task, rules)
    is_over = at_instant != Outcome.RUNNING
    last = jnp.where(jnp.any(is_over), jnp.argmax(is_over), is_over.shape[0] - 1).astype(jnp.int32)
    is_late = num_decisions >= task.max_decisions
    timed_out = jnp.where(is_late, Outcome.TIMEOUT, Outcome.RUNNING)
    outcome = jnp.where(jnp.any(is_over), at_instant[last], timed_out).astype(jnp.int32)

    counted = (jnp.arange(is_over.shape[0]) <= last) & track.is_finite
    return Verdict(
        outcome=outcome,
        last=last,
        terms=_reward_terms(start_xy_m, track, counted, scene, outcome, task),
        path_length_m=_path_length(start_xy_m, track, counted),
        min_clearance_m=jnp.min(jnp.where(counted, rock_clearance_m(track.xy_m, scene), jnp.inf)),
    )


def outcome_at_instants(track: Track, scene: Scene, task: TaskConfig, rules: SceneConfig) -> Int32[Array, "J"]:
    """The outcome that holds at each judged instant, by itself (``RUNNING`` where none does)."""
    goal_distance = jnp.linalg.norm(track.xy_m - scene.goal_xy_m, axis=-1)
    is_success = goal_distance < task.goal_radius_m
    is_off_map = jnp.any(jnp.abs(track.xy_m) > rules.map_size_m / 2, axis=-1)
    is_fall = is_off_map | (track.up_z < jnp.cos(jnp.radians(task.max_tilt_deg)))
    is_collision = rock_clearance_m(track.xy_m, scene) < task.collision_radius_m + task.collision_margin_m
    by_rank = [~track.is_finite, is_collision, is_fall, is_success]
    outcomes = [Outcome.UNSTABLE, Outcome.COLLISION, Outcome.FALL, Outcome.SUCCESS]
    choices = [jnp.int32(outcome) for outcome in outcomes]
    return jnp.select(by_rank, choices, jnp.int32(Outcome.RUNNING))


def rock_clearance_m(xy_m: Float32[Array, "J 2"], scene: Scene) -> Float32[Array, "J"]:
    """Distance from each place to the nearest rock's centre; inf without rocks."""
    distance = jnp.linalg.norm(xy_m[:, None] - scene.rock_xy_m[None], axis=-1)
    is_there = scene.rock_xy_m[:, 0] < FAR_AWAY_M / 2
    return jnp.min(distance, axis=-1, initial=jnp.inf, where=is_there)


def _reward_terms(
    start_xy: Array, track: Track, counted: Array, scene: Scene, outcome: Array, task: TaskConfig
) -> RewardTerms:
    """Progress is summed over the judged intervals, which telescopes to first minus last distance."""
    places = jnp.concatenate([start_xy[None], track.xy_m])
    distance = jnp.linalg.norm(places - scene.goal_xy_m, axis=-1)
    progress = jnp.sum(jnp.where(counted, distance[:-1] - distance[1:], 0.0))

    def reward_if(ended_by: Outcome, reward: float) -> Array:
        return jnp.where(outcome == ended_by, jnp.float32(reward), jnp.float32(0.0))

    return RewardTerms(
        progress=task.progress_reward_per_m * progress,
        collision=reward_if(Outcome.COLLISION, task.collision_reward),
        fall=reward_if(Outcome.FALL, task.fall_reward),
        timeout=reward_if(Outcome.TIMEOUT, task.timeout_reward),
    )


def _path_length(start_xy: Array, track: Track, counted: Array) -> Float32[Array, ""]:
    places = jnp.concatenate([start_xy[None], track.xy_m])
    steps = jnp.linalg.norm(places[1:] - places[:-1], axis=-1)
    return jnp.sum(jnp.where(counted, steps, 0.0))

"""Observations that are vectors: the true state, and the nearest rocks. Pure JAX, one environment; vmap for more."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32

from segvisrl_jax.config import EnvConfig, ObservationKind
from segvisrl_jax.env.pose import in_rover_frame, yaw_rad
from segvisrl_jax.types import RoverState

TYPICAL_TURN_RATE_RAD_S = 0.5  # scales the turn rate in the state observation to about 1
STATE_SIZE = 7
NUM_NEAREST_ROCKS = 8  # that a vector holds: at 64 rocks on the map, those within 5 m
ROCK_SIZE = 3  # direction (forward, left), closeness
ROCK_RANGE_M = 6.0  # rocks beyond are left out: half a minute's drive


def vector_size(obs: ObservationKind) -> int:
    """Length of ``state`` or ``state_and_rocks``."""
    return STATE_SIZE + (NUM_NEAREST_ROCKS * ROCK_SIZE if obs == "state_and_rocks" else 0)


def vector_observation(state: RoverState, config: EnvConfig) -> Float32[Array, "D"]:
    """``state`` or ``state_and_rocks`` (``RoverEnv`` says what stands where)."""
    vector = _state_vector(state, config)
    return jnp.append(vector, _rock_vector(state, config)) if config.obs == "state_and_rocks" else vector


def _state_vector(state: RoverState, config: EnvConfig) -> Float32[Array, "7"]:
    qpos, qvel = state.physics.qpos, state.physics.qvel
    heading = yaw_rad(qpos)
    goal = in_rover_frame(state.scene.goal_xy_m - qpos[:2], heading)
    velocity = in_rover_frame(qvel[:2], heading)
    parts = [
        goal / config.scene.goal_distance_max_m,
        jnp.stack([jnp.sin(heading), jnp.cos(heading)]),
        velocity / config.physics.top_speed_m_s,
        qvel[5:6] / TYPICAL_TURN_RATE_RAD_S,
    ]
    return jnp.concatenate(parts).astype(jnp.float32)


def _rock_vector(state: RoverState, config: EnvConfig) -> Float32[Array, "D"]:
    """The nearest rocks, 3 numbers each, zeros where there are fewer.

    Straight ahead leads to a collision where the share of the direction to the left is between minus and plus the
    closeness, at any distance: a network has to compare two numbers.
    """
    offset = state.scene.rock_xy_m - state.physics.qpos[:2]
    nearness, order = jax.lax.top_k(-jnp.linalg.norm(offset, axis=-1), min(NUM_NEAREST_ROCKS, len(offset)))
    distance = -nearness[:, None]
    place = jax.vmap(in_rover_frame, in_axes=(0, None))(offset[order], yaw_rad(state.physics.qpos))
    limit = config.task.collision_radius_m
    rocks = jnp.concatenate([place, jnp.full_like(distance, limit)], axis=-1) / jnp.maximum(distance, limit)
    seen = jnp.where(distance <= ROCK_RANGE_M, rocks, 0.0)
    return jnp.pad(seen.ravel(), (0, NUM_NEAREST_ROCKS * ROCK_SIZE - seen.size)).astype(jnp.float32)

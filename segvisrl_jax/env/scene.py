"""``key -> Scene``: where the goal, the rocks and the sun are. Pure JAX, one scene; vmap for more.

The rules are those of the paper's section III-A and of ``SceneConfig``; ``SceneConfig`` refuses settings under which
the rejection sampling here could not end.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, PRNGKeyArray

from segvisrl_jax.config import SceneConfig
from segvisrl_jax.types import ConvexSolids, Scene

FAR_AWAY_M = 1e4  # where a rock stands that is not there, or not yet: it keeps nothing clear


def sample_scene(key: PRNGKeyArray, config: SceneConfig, rocks: ConvexSolids) -> Scene:
    """Draws one scene.

    Args:
        key: one PRNG key.
        config: the rules.
        rocks: the rock library (``env.rocks.rock_library(config)``).

    Returns:
        A scene with ``config.most_rocks`` rocks: the goal uniform over the part of the map between the least and the
        largest distance from the start; each rock uniform over the part of the map that keeps clear of start, goal
        and earlier rocks, each of a different shape. With ``random_num_rocks_max``, a random number of them
        stands far outside the map.
    """
    goal_key, shape_key, place_key, yaw_key, start_key = jax.random.split(key, 5)
    goal_xy = _sample_goal(goal_key, config)
    shape = jax.random.permutation(shape_key, config.num_rock_shapes)[: config.most_rocks]
    shape = shape.astype(jnp.int32)
    rock_xy = _place_rocks(place_key, config, goal_xy, jnp.asarray(rocks.radius_m)[shape])
    if config.random_num_rocks_max:
        number = jax.random.randint(jax.random.fold_in(shape_key, 1), (), 0, config.most_rocks + 1)
        rock_xy = jnp.where(jnp.arange(config.most_rocks)[:, None] < number, rock_xy, FAR_AWAY_M)
    yaw = jax.random.uniform(yaw_key, (config.most_rocks + 1,), minval=-jnp.pi, maxval=jnp.pi)
    return Scene(
        goal_xy_m=goal_xy,
        goal_yaw_rad=yaw[-1],
        rock_xy_m=rock_xy,
        rock_yaw_rad=yaw[:-1],
        rock_shape=shape,
        start_yaw_rad=_sample_start_yaw(start_key, config.random_start_yaw_share),
        sun_direction=jnp.asarray(sun_direction(config)),
    )


def sun_direction(config: SceneConfig) -> Float32[np.ndarray, "3"]:
    """Unit vector from the ground towards the sun."""
    azimuth, elevation = np.radians(config.sun_azimuth_deg), np.radians(config.sun_elevation_deg)
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], np.float32)


def _sample_goal(key: PRNGKeyArray, config: SceneConfig) -> Float32[Array, "2"]:
    start = jnp.asarray(config.start_xy_m, jnp.float32)

    def is_allowed(xy: Array) -> Bool[Array, ""]:
        distance = jnp.linalg.norm(xy - start)
        return (distance >= config.goal_distance_min_m) & (distance <= config.goal_distance_max_m)

    return _draw_until(key, config.map_size_m, is_allowed)


def _place_rocks(
    key: PRNGKeyArray, config: SceneConfig, goal_xy: Float32[Array, "2"], radius: Float32[Array, "R"]
) -> Float32[Array, "R 2"]:
    """One rock after another, each drawn until it keeps clear of start, goal and the rocks before it."""
    if config.most_rocks == 0:
        return jnp.zeros((0, 2), jnp.float32)
    start = jnp.asarray(config.start_xy_m, jnp.float32)
    nowhere = jnp.full((config.most_rocks, 2), FAR_AWAY_M, jnp.float32)

    def place(placed: Array, rock: tuple[Array, PRNGKeyArray]) -> tuple[Array, None]:
        index, rock_key = rock

        def is_allowed(xy: Array) -> Bool[Array, ""]:
            clear_of_start = jnp.linalg.norm(xy - start) >= config.rock_start_clearance_m
            clear_of_goal = jnp.linalg.norm(xy - goal_xy) >= config.rock_goal_clearance_m
            clear_of_rocks = jnp.all(jnp.linalg.norm(placed - xy, axis=-1) >= radius + radius[index])
            return clear_of_start & clear_of_goal & clear_of_rocks

        return placed.at[index].set(_draw_until(rock_key, config.map_size_m, is_allowed)), None

    keys = jax.random.split(key, config.most_rocks)
    placed, _ = jax.lax.scan(place, nowhere, (jnp.arange(config.most_rocks), keys))
    return placed


def _draw_until(key: PRNGKeyArray, map_size_m: float, is_allowed) -> Float32[Array, "2"]:
    """Uniform points over the map until one is allowed."""
    half = map_size_m / 2

    def draw(key: PRNGKeyArray) -> tuple[PRNGKeyArray, Float32[Array, "2"]]:
        next_key, draw_key = jax.random.split(key)
        return next_key, jax.random.uniform(draw_key, (2,), minval=-half, maxval=half)

    _, xy = jax.lax.while_loop(lambda s: ~is_allowed(s[1]), lambda s: draw(s[0]), draw(key))
    return xy


def _sample_start_yaw(key: PRNGKeyArray, random_share: float) -> Float32[Array, ""]:
    """Facing inwards (0), or, with probability ``random_share``, uniform."""
    choice_key, yaw_key = jax.random.split(key)
    yaw = jax.random.uniform(yaw_key, (), minval=-jnp.pi, maxval=jnp.pi)
    return jnp.where(jax.random.uniform(choice_key, ()) < random_share, yaw, 0.0)

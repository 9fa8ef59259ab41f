"""The privileged planner: it knows the goal and every rock, plans the shortest way around them, and follows it.

It is the ceiling of what driving can reach at any number of rocks. The path is planned where an episode begins, on the
host (``shortest_path``, NumPy behind a callback); following it is pure pursuit in JAX (Coulter, "Implementation of the
pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992).
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from segvisrl_jax.config import EnvConfig
from segvisrl_jax.cpu import make_callbacks_safe
from segvisrl_jax.env.pose import in_rover_frame, yaw_rad
from segvisrl_jax.training.policy import Policy
from segvisrl_jax.training.shortest_path import shortest_path
from segvisrl_jax.types import RoverState

NUM_POINTS = 512  # of a path, evenly spaced: on the paper's map 3 cm apart
MARGINS_M = (0.10, 0.05, 0.02)  # kept from a collision, the first with which there is a path; tracking errs by 4 cm
GOAL_SHARE = 0.8  # of the goal's radius: the path ends well inside
LOOKAHEAD_M = 0.4  # two decisions at full speed; 0.25 m weaves, 0.5 m cuts corners by a centimetre more
TRACK_M = 0.5  # turning is as if the wheels' track were this wide: 0.2 m and the skid, measured
SHARPEST_PER_M = 2 / TRACK_M  # the curvature at which the inner wheels stand still
NO_LENGTH_M = 1e-6

Path = Float32[Array, "K 2"]
"""K = NUM_POINTS places of the rover, world frame, evenly spaced, leading on beyond the goal's edge."""


def planner(config: EnvConfig | None = None) -> Policy:
    """The planner for scenes under these rules (None: the paper's); its carry is a path for every rover, (B, K, 2).

    Where there is no path with the widest margin, it tries narrower ones, and drives straight at the goal where
    there is none at all. On a CPU, ask for it before the first array is made (``cpu.make_callbacks_safe``).
    """
    make_callbacks_safe()
    plan = functools.partial(_plan_where, config or EnvConfig())

    def plan_anew(begins, rover: RoverState, paths):
        where = rover.physics.qpos[:, :2], rover.scene.goal_xy_m, rover.scene.rock_xy_m
        return jax.pure_callback(plan, jax.ShapeDtypeStruct(paths.shape, jnp.float32), begins, *where, paths)

    def act(params, carry, rover, observation, is_first, key):
        begins = is_first > 0
        paths = jax.lax.cond(jnp.any(begins), plan_anew, lambda _begins, _rover, old: old, begins, rover, carry)
        return paths, jax.vmap(pursue)(paths, rover)

    def no_paths(num_envs: int) -> Float32[Array, "B K 2"]:
        return jnp.zeros((num_envs, NUM_POINTS, 2), jnp.float32)

    return Policy("planner", observes=False, initial_carry=no_paths, act=act)


def _plan_where(
    config: EnvConfig,
    begins: Bool[Array, "B"],
    start_xy: Float32[Array, "B 2"],
    goal_xy: Float32[Array, "B 2"],
    rock_xy: Float32[Array, "B R 2"],
    paths: Float32[Array, "B K 2"],
) -> Float32[np.ndarray, "B K 2"]:
    """The callback: fresh paths where an episode begins, the old ones elsewhere. NumPy only: JAX can hang."""
    planned = np.array(paths, np.float32)
    starts, goals, rocks = (np.asarray(array, np.float64) for array in (start_xy, goal_xy, rock_xy))
    for i in np.flatnonzero(np.asarray(begins)):
        planned[i] = plan_path(starts[i], goals[i], rocks[i], config)
    return planned


def plan_path(
    start_xy: Float[np.ndarray, "2"],
    goal_xy: Float[np.ndarray, "2"],
    rock_xy: Float[np.ndarray, "R 2"],
    config: EnvConfig,
) -> Float32[np.ndarray, "K 2"]:
    """Where to drive: the shortest path that keeps a margin from rocks and edge, or the straight line without one.

    Returns:
        NUM_POINTS places, evenly spaced, world frame. The path leads straight on beyond its end in the goal by the
        goal's radius, so that there is a place to head for until the goal is reached.
    """
    points = next(_paths_with_margins(start_xy, goal_xy, rock_xy, config), np.stack([start_xy, goal_xy]))
    last_leg = points[-1] - points[-2]
    direction = last_leg / max(float(np.linalg.norm(last_leg)), NO_LENGTH_M)
    return _evenly_spaced(np.concatenate([points, [points[-1] + config.task.goal_radius_m * direction]]))


def _paths_with_margins(start_xy, goal_xy, rock_xy, config: EnvConfig):
    """The shortest path for each margin with which there is one, widest first."""
    task = config.task
    ends_m = max(float(np.abs(start_xy).max()), float(np.abs(goal_xy).max()))  # they may be nearer to the edge
    for margin_m in MARGINS_M:
        half_size_m = max(config.scene.map_size_m / 2 - margin_m, ends_m)
        rock_radius_m = task.collision_radius_m + margin_m
        goal_radius_m = GOAL_SHARE * task.goal_radius_m
        found = shortest_path(start_xy, goal_xy, goal_radius_m, rock_xy, rock_radius_m, half_size_m)
        if len(found.points_m) > 1:
            yield found.points_m


def _evenly_spaced(points: Float[np.ndarray, "P 2"]) -> Float32[np.ndarray, "K 2"]:
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    even = np.linspace(0.0, driven[-1], NUM_POINTS)
    return np.stack([np.interp(even, driven, points[:, k]) for k in range(2)], axis=-1).astype(np.float32)


def pursue(path: Path, rover: RoverState) -> Float32[Array, "2"]:
    """The wheel speeds that lead the rover on a circle to a place ahead on its path (Coulter, section 2). Unbatched.

    The outer wheels turn at full speed. What lies behind is turned to as sharply as the rover can.
    """
    here = rover.physics.qpos[:2]
    spacing = jnp.maximum(jnp.linalg.norm(path[1] - path[0]), NO_LENGTH_M)
    nearest = jnp.argmin(jnp.sum((path - here) ** 2, axis=-1))
    ahead = nearest + jnp.maximum(jnp.round(LOOKAHEAD_M / spacing), 1).astype(jnp.int32)
    target = in_rover_frame(path[jnp.minimum(ahead, NUM_POINTS - 1)] - here, yaw_rad(rover.physics.qpos))
    circle = 2 * target[1] / jnp.maximum(jnp.sum(target**2), NO_LENGTH_M)
    curvature = jnp.where(target[0] > 0, circle, jnp.copysign(SHARPEST_PER_M, target[1]))
    turn = jnp.clip(curvature / SHARPEST_PER_M, -1.0, 1.0)
    wheels = jnp.stack([1 - turn, 1 + turn])
    return wheels / jnp.max(wheels)

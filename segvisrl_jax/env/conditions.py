"""Conditions at work on scenes, poses, frames and commands. Pure JAX, one environment; vmap for more.

What is random in a frame is drawn from a key that follows from the scene, the rover's pose and the time. So nothing
random is kept in the state, the same frame is drawn the same again, and no episode depends on those beside it.
What happens to the image's pixels is in ``vision.conditions``.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, Int32, PRNGKeyArray, UInt32

from segvisrl_jax.config import EnvConfig, SceneConfig, TaskConfig
from segvisrl_jax.config.conditions import GHOST_RANGE_M, RANDOM_RANGES, RANDOM_SUN_ELEVATION_DEG
from segvisrl_jax.env.pose import CameraMount
from segvisrl_jax.env.scene import FAR_AWAY_M
from segvisrl_jax.types import Action, CameraPose, Conditions, Frame, PhysicsState, RoverState, Scene

_SUN, _FIELD, _FRAME, _ARRIVAL = 1001, 1002, 1003, 1004  # names of streams; not those that scenes are drawn from
_MISSED, _GHOSTS = 1, 2  # ... and of a frame's own; vision.conditions has others


def with_conditions(key: PRNGKeyArray, scene: Scene, config: EnvConfig) -> Scene:
    """The scene under the configured conditions: those that are set, those drawn from the key, and a sun drawn too."""
    drawn = {}
    for number, name in enumerate(config.conditions.varied(config.obs)):
        value = jnp.float32(getattr(config.conditions, name))
        if config.conditions.draws(name):
            field_key = jax.random.fold_in(jax.random.fold_in(key, _FIELD), number)
            value = _draw(field_key, name)
        drawn[name] = jnp.round(value).astype(jnp.int32) if name == "num_ghost_rocks" else value
    scene = dataclasses.replace(scene, conditions=Conditions(**drawn))
    if config.conditions.randomize and config.obs == "rgb":
        scene = dataclasses.replace(scene, sun_direction=_draw_sun(jax.random.fold_in(key, _SUN)))
    return scene


def _draw(key: PRNGKeyArray, name: str) -> Float32[Array, ""]:
    """Uniform in its range; whole numbers all as likely."""
    low, high = RANDOM_RANGES[name]
    if name == "num_ghost_rocks":
        return jax.random.randint(key, (), int(low), int(high) + 1).astype(jnp.float32)
    return jax.random.uniform(key, (), minval=low, maxval=high)


def _draw_sun(key: PRNGKeyArray) -> Float32[Array, "3"]:
    """Towards the sun: any azimuth, the elevation uniform in its range."""
    low, high = np.radians(RANDOM_SUN_ELEVATION_DEG).astype(np.float32)
    turn, height = jax.random.uniform(key, (2,))
    azimuth, elevation = 2 * jnp.pi * turn, low + (high - low) * height
    flat = jnp.cos(elevation)
    return jnp.stack([flat * jnp.cos(azimuth), flat * jnp.sin(azimuth), jnp.sin(elevation)])


# Driving


def wheel_shares(state: RoverState, action: Action, task: TaskConfig) -> Float32[Array, "*J 2"]:
    """What the wheels follow: the action (2,) itself, or, with latency, (J, 2), the one before at first."""
    conditions, shares = state.scene.conditions, action
    if conditions.latency_s is not None and state.last_action is not None:
        begins_s = task.judge_dt_s * np.arange(task.num_judgements, dtype=np.float32)
        is_late = begins_s < conditions.latency_s - task.judge_dt_s / 2
        shares = jnp.where(is_late[:, None], state.last_action, action)
    gains = (conditions.left_wheel_gain, conditions.right_wheel_gain)
    if gains == (None, None):
        return shares
    weak = jnp.stack([jnp.float32(1.0) if gain is None else gain for gain in gains])
    return jnp.clip(shares, 0.0, 1.0) * weak


def first_memory(physics: PhysicsState, scene: Scene) -> dict[str, Frame | Array | None]:
    """What a state at the start remembers: the first frame, and standing still."""
    no_decision = jnp.int32(0)
    drops, is_late = scene.conditions.dropped_frame_share is not None, scene.conditions.latency_s is not None
    return {
        "last_frame": Frame(physics.qpos, no_decision) if drops else None,
        "last_action": jnp.zeros(2, jnp.float32) if is_late else None,
    }


def next_memory(
    state: RoverState, action: Action, physics: PhysicsState, num_decisions: Int32[Array, ""]
) -> dict[str, Frame | Array | None]:
    """What a state remembers after a decision: the new frame where it arrives, and what was commanded."""
    share, is_late = state.scene.conditions.dropped_frame_share, state.scene.conditions.latency_s is not None
    frame = None
    if share is not None:
        new = Frame(physics.qpos, num_decisions)
        key = jax.random.fold_in(frame_key(frame_words(state.scene, new)), _ARRIVAL)
        arrives = jax.random.uniform(key, ()) >= share
        frame = jax.tree.map(functools.partial(jnp.where, arrives), new, state.last_frame)
    return {"last_frame": frame, "last_action": jnp.asarray(action, jnp.float32) if is_late else None}


# Seeing


def seen_frame(state: RoverState) -> Frame:
    """The frame that the agent sees now."""
    return state.last_frame or Frame(state.physics.qpos, state.num_decisions)


def frame_words(scene: Scene, frame: Frame) -> UInt32[Array, "6"]:
    """The bits that a frame's randomness follows from. Of stored numbers only: what is computed may round otherwise."""
    numbers = jnp.concatenate([scene.goal_xy_m, frame.qpos[:3]])
    return jnp.append(jax.lax.bitcast_convert_type(numbers, jnp.uint32), frame.num_decisions.astype(jnp.uint32))


def frame_key(words: UInt32[Array, "6"]) -> PRNGKeyArray:
    """The key of one frame's randomness."""
    return functools.reduce(jax.random.fold_in, list(words), jax.random.key(_FRAME))


def moved_mount(mount: CameraMount, conditions: Conditions) -> CameraMount:
    """The camera's mount, moved up and turned down."""
    position, rotation = mount.position_m, mount.rotation
    if conditions.camera_height_offset_m is not None:
        position = position + conditions.camera_height_offset_m * np.array([0.0, 0.0, 1.0], np.float32)
    if conditions.camera_pitch_offset_deg is not None:
        down = jnp.radians(conditions.camera_pitch_offset_deg)
        cos, sin, zero, one = jnp.cos(down), jnp.sin(down), jnp.float32(0.0), jnp.float32(1.0)
        about_right = jnp.stack(
            [jnp.stack([one, zero, zero]), jnp.stack([zero, cos, sin]), jnp.stack([zero, -sin, cos])]
        )
        rotation = jnp.matmul(rotation, about_right, precision="highest")
    return CameraMount(position, rotation)


def segmented_scene(key: PRNGKeyArray, scene: Scene, camera: CameraPose, config: EnvConfig) -> Scene:
    """The scene as a segmentation takes it to be in one frame: some rocks missed, some made up."""
    conditions = scene.conditions
    if conditions.missed_rock_share is not None:
        fate = jax.random.uniform(jax.random.fold_in(key, _MISSED), scene.rock_shape.shape)
        is_missed = fate < conditions.missed_rock_share
        scene = dataclasses.replace(scene, rock_xy_m=jnp.where(is_missed[:, None], FAR_AWAY_M, scene.rock_xy_m))
    if conditions.num_ghost_rocks is not None:
        ghosts_key = jax.random.fold_in(key, _GHOSTS)
        scene = _with_ghosts(ghosts_key, scene, camera, conditions.num_ghost_rocks, config)
    return scene


def _with_ghosts(
    key: PRNGKeyArray, scene: Scene, camera: CameraPose, number: Int32[Array, ""], config: EnvConfig
) -> Scene:
    """More rocks, of shapes that the scene does not use, uniform over the part of the ground that is in view."""
    most = config.conditions.most_ghost_rocks
    shape_key, yaw_key, distance_key, bearing_key = jax.random.split(key, 4)
    half_view = np.radians(config.camera.horizontal_fov_deg / 2)
    low, high = GHOST_RANGE_M
    distance = jnp.sqrt(jax.random.uniform(distance_key, (most,), minval=low**2, maxval=high**2))
    heading = jnp.arctan2(-camera.rotation[1, 2], -camera.rotation[0, 2])
    angle = heading + jax.random.uniform(bearing_key, (most,), minval=-half_view, maxval=half_view)
    place = camera.position_m[:2] + distance[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    is_there = jnp.arange(most) < number
    yaw = jax.random.uniform(yaw_key, (most,), minval=-jnp.pi, maxval=jnp.pi)
    return dataclasses.replace(
        scene,
        rock_xy_m=jnp.concatenate([scene.rock_xy_m, jnp.where(is_there[:, None], place, FAR_AWAY_M)]),
        rock_yaw_rad=jnp.concatenate([scene.rock_yaw_rad, yaw]),
        rock_shape=jnp.concatenate([scene.rock_shape, _unused_shapes(shape_key, scene, config.scene)[:most]]),
    )


def _unused_shapes(key: PRNGKeyArray, scene: Scene, config: SceneConfig) -> Int32[Array, "shapes"]:
    """Rows of the rock library in random order, those that the scene uses last."""
    order = jax.random.uniform(key, (config.num_rock_shapes,)).at[scene.rock_shape].set(jnp.inf)
    return jnp.argsort(order).astype(jnp.int32)

"""One recorded episode: driving it, and the frames of its video (camera, segmentation, what the policy sees, map)."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from segvisrl_jax.config import EnvConfig, replace_fields
from segvisrl_jax.env.pose import camera_mount, camera_pose, yaw_rad
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.report.layout import SceneMap
from segvisrl_jax.report.video import Pane, compose_frame, top_view_frame
from segvisrl_jax.training.policy import Policy
from segvisrl_jax.types import Outcome, RoverState
from segvisrl_jax.vision.classes import PALETTE
from segvisrl_jax.vision.renderer import make_renderer

VIEW_WIDTH_PX, VIEW_HEIGHT_PX = (
    640,
    360,
)  # of the camera panes: the D435's picture at a third of its size
HOLD_FRAMES = 8  # the last frame stays a second


@dataclasses.dataclass(frozen=True)
class Episode:
    """States (T + 1, ...), from the start to the end, and what the policy saw in each."""

    states: RoverState
    observations: UInt8[np.ndarray, "T H W 3"] | None  # None for a policy without images

    @property
    def outcome(self) -> Outcome:
        """How it ended."""
        return Outcome(int(self.states.outcome[-1]))

    @property
    def xy_m(self) -> Float[np.ndarray, "T 2"]:
        """Where the rover was."""
        return np.asarray(self.states.physics.qpos[:, :2])


def drive_episode(env: RoverEnv, policy: Policy, params: Any, stream: PRNGKeyArray, episode: int = 0) -> Episode:
    """Drives one numbered scene of a stream to its end: the same one as ``Evaluator.run`` with that number."""

    @jax.jit
    def decide(params: Any, carry: Any, rover: RoverState, is_first: Array, key: PRNGKeyArray):
        seen = jax.vmap(env.observe)(rover)
        carry, action = policy.act(params, carry, rover, seen, is_first, key)
        after, _ = jax.vmap(env.advance)(rover, action)
        return carry, after, seen

    scene_key = jax.random.fold_in(stream, episode)
    rover = jax.jit(jax.vmap(env.initial_state))(scene_key[None])
    carry, is_first = policy.initial_carry(1), jnp.ones(1, jnp.float32)
    states, seen_images = [jax.device_get(rover)], []
    while int(rover.outcome[0]) == Outcome.RUNNING:
        key = jax.random.fold_in(scene_key, len(states))
        carry, rover, seen = decide(params, carry, rover, is_first, key)
        is_first = jnp.zeros(1, jnp.float32)
        states.append(jax.device_get(rover))
        seen_images.append(np.asarray(seen[0]))
    seen_images.append(np.asarray(jax.jit(env.observe)(jax.tree.map(lambda x: x[0], rover))))
    stacked = jax.tree.map(lambda *leaves: np.concatenate(leaves), *states)
    return Episode(stacked, np.stack(seen_images) if seen_images[0].ndim == 3 else None)


def episode_frames(env: RoverEnv, episode: Episode, title: str = "") -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """The frames of an episode's video, one a decision, the last one held."""
    view = _view_config(env.config)
    segmented, coloured = (_camera_view(env, replace_fields(view, obs=kind)) for kind in ("segmentation", "rgb"))
    scene = scene_map(env, episode)
    last = len(episode.xy_m) - 1
    for step in range(last + 1):
        rover = jax.tree.map(lambda leaf, i=step: leaf[i], episode.states)
        camera = [
            Pane(np.asarray(coloured(rover)), "onboard camera"),
            Pane(np.asarray(segmented(rover)), "segmentation"),
        ]
        if episode.observations is not None:
            camera.append(Pane(episode.observations[step], _observation_caption(env)))
        heading = float(yaw_rad(rover.physics.qpos))
        above = top_view_frame(scene, episode.xy_m[: step + 1], heading)
        status = episode.outcome.name.lower() if step == last else "driving"
        label = f"{title}   {step * env.dt:3.0f} s   {status}"
        frame = compose_frame(
            [camera, [Pane(above, "map, 25 m" if scene.map_half_size_m == 12.5 else "map")]],
            title=label,
        )
        yield frame
    for _ in range(HOLD_FRAMES):
        yield frame


def scene_map(env: RoverEnv, episode: Episode) -> SceneMap:
    """The episode's scene from above."""
    scene = jax.tree.map(lambda leaf: np.asarray(leaf[0]), episode.states.scene)
    return SceneMap(
        start_xy_m=np.asarray(env.config.scene.start_xy_m),
        goal_xy_m=scene.goal_xy_m,
        rock_xy_m=scene.rock_xy_m,
        rock_radius_m=env.rocks.radius_m[scene.rock_shape],
        map_half_size_m=env.config.scene.map_size_m / 2,
        collision_radius_m=env.config.task.collision_radius_m,
        goal_radius_m=env.config.task.goal_radius_m,
    )


def _view_config(config: EnvConfig) -> EnvConfig:
    return replace_fields(config, width_px=VIEW_WIDTH_PX, height_px=VIEW_HEIGHT_PX, scale=1.0)


def _camera_view(env: RoverEnv, config: EnvConfig):
    """A jitted function from a state to the whole camera image, (360, 640, 3) uint8."""
    camera = config.camera
    renderer = make_renderer(config, np.arange(camera.height_px), np.arange(camera.width_px))
    mount = camera_mount(env.mj_model)

    def draw(rover: RoverState) -> UInt8[Array, "H W 3"]:
        pose = camera_pose(rover.physics, mount)
        if config.obs == "rgb":
            return renderer.rgb(rover.scene, pose)
        return jnp.asarray(PALETTE)[renderer.classes(rover.scene, pose)]

    return jax.jit(draw)


def _observation_caption(env: RoverEnv) -> str:
    rows, columns, _ = env.observation_shape
    return f"what the policy sees, {columns} x {rows}"

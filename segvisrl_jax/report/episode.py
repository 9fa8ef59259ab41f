"""Recorded episodes: driving them, and the frames of one's video (camera, segmentation, what the policy sees, map)."""

import copy
import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from segvisrl_jax.config import ConditionsConfig, ObservationKind, replace_fields
from segvisrl_jax.env.pose import yaw_rad
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import select
from segvisrl_jax.report import layout
from segvisrl_jax.report.layout import SceneMap
from segvisrl_jax.report.video import Pane, compose_frame, top_view_frame
from segvisrl_jax.training.policy import Policy
from segvisrl_jax.types import Outcome, RoverState, Scene
from segvisrl_jax.vision.classes import PALETTE
from segvisrl_jax.vision.renderer import make_renderer

VIEW_WIDTH_PX, VIEW_HEIGHT_PX = 640, 360  # of the camera panes: the D435's picture at a third of its size
BATCH = 64  # episodes that are driven side by side
HOLD_FRAMES = 8  # the last frame stays a second


@dataclasses.dataclass(frozen=True)
class Episode:
    """States (T + 1, ...), from the start to the end, and what the policy saw in each."""

    states: RoverState
    observations: UInt8[np.ndarray, "T H W 3"] | None  # None without images, or where they were not kept

    @property
    def outcome(self) -> Outcome:
        """How it ended."""
        return Outcome(int(self.states.outcome[-1]))

    @property
    def num_decisions(self) -> int:
        """How many it took."""
        return int(self.states.num_decisions[-1])

    @property
    def min_clearance_m(self) -> float:
        """The least distance to a rock's centre; infinite without rocks."""
        return float(self.states.min_clearance_m[-1])

    def state(self, step: int) -> RoverState:
        """One of its states; -1 is the last."""
        return jax.tree.map(lambda leaf: leaf[step], self.states)

    @property
    def xy_m(self) -> Float[np.ndarray, "T 2"]:
        """Where the rover was."""
        return np.asarray(self.states.physics.qpos[:, :2])


def drive_episode(env: RoverEnv, policy: Policy, params: Any, stream: PRNGKeyArray, episode: int) -> Episode:
    """Drives one numbered scene of a stream to its end: the same one as ``Evaluator.run`` with that number.

    Keeps what the policy saw.
    """
    driven = drive_episodes(env, policy, params, stream, [episode])[0]
    return driven if len(env.observation_shape) != 3 else dataclasses.replace(driven, observations=_seen(env, driven))


def _seen(env: RoverEnv, episode: Episode) -> UInt8[np.ndarray, "T H W 3"]:
    """What there was to see in each of its states."""
    observe = jax.jit(env.observe)
    return np.stack([np.asarray(observe(episode.state(step))) for step in range(len(episode.xy_m))])


def drive_episodes(
    env: RoverEnv,
    policy: Policy,
    params: Any,
    stream: PRNGKeyArray,
    episodes: Sequence[int],
    on_progress: Callable[[int], None] = lambda done: None,
) -> list[Episode]:
    """Drives numbered scenes of a stream to their ends, up to ``BATCH`` side by side; keeps states, not observations.

    The scenes are those of ``Evaluator.run``, and what draws no actions drives them in the same way.
    """
    decide = jax.jit(functools.partial(_decide, env, policy))
    start = jax.jit(jax.vmap(lambda number: env.initial_state(jax.random.fold_in(stream, number))))
    size = min(BATCH, len(episodes))
    driven: list[Episode] = []
    for first in range(0, len(episodes), size):
        numbers = list(episodes[first : first + size])
        filled = jnp.array(numbers + numbers[-1:] * (size - len(numbers)), jnp.int32)
        key = jax.random.fold_in(stream, int(filled[0]))
        states = _drive_batch(decide, params, start(filled), policy.initial_carry(size), key)
        driven += [_episode(states, place) for place in range(len(numbers))]
        on_progress(len(driven))
    return driven


def _drive_batch(decide: Callable, params: Any, rover: RoverState, carry: Any, key: PRNGKeyArray) -> RoverState:
    """States (T + 1, B, ...) of B episodes until the last one's end; those that ended before stand still."""
    is_first = jnp.ones(rover.outcome.shape, jnp.float32)
    states = [jax.device_get(rover)]
    while np.any(states[-1].outcome == Outcome.RUNNING):
        carry, rover = decide(params, carry, rover, is_first, jax.random.fold_in(key, len(states)))
        is_first = jnp.zeros_like(is_first)
        states.append(jax.device_get(rover))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


def _decide(env: RoverEnv, policy: Policy, params: Any, carry: Any, rover: RoverState, is_first: Array, key: Array):
    """One decision of every episode that is still going on."""
    seen = jax.vmap(env.observe)(rover) if policy.observes else None
    carry, action = policy.act(params, carry, rover, seen, is_first, key)
    after, _ = jax.vmap(env.advance)(rover, action)
    return carry, select(rover.outcome == Outcome.RUNNING, after, rover)


def _episode(states: RoverState, place: int) -> Episode:
    """One of B, without what follows its end."""
    last = int(states.num_decisions[-1, place])
    return Episode(jax.tree.map(lambda leaf: leaf[: last + 1, place], states), None)


def episode_frames(env: RoverEnv, episode: Episode, title: str = "") -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """The frames of an episode's video, one a decision, the last one held."""
    draw = EpisodeView(env)
    for step in range(len(episode.xy_m)):
        seen = None if episode.observations is None else episode.observations[step]
        frame = draw(episode.state(step), episode.xy_m[: step + 1], seen, title)
        yield frame
    for _ in range(HOLD_FRAMES):
        yield frame


class EpisodeView:
    """Draws one moment of an episode: onboard camera, segmentation, what the policy sees, the map with the trail."""

    def __init__(self, env: RoverEnv) -> None:
        self._env = env
        self.segmented, self.coloured = (camera_view(env, kind) for kind in ("segmentation", "rgb"))

    def of(self, env: RoverEnv) -> "EpisodeView":
        """The same view, compiled already, for an environment that differs only in what its policy sees."""
        other = copy.copy(self)
        other._env = env
        return other

    def __call__(
        self,
        rover: RoverState,
        trail_xy_m: Float[np.ndarray, "T 2"],
        observation: UInt8[np.ndarray, "H W 3"] | None,
        title: str = "",
    ) -> UInt8[np.ndarray, "H W 3"]:
        """One frame.

        Args:
            rover: the state. Unbatched.
            trail_xy_m: where the rover was so far; the last row is where it is.
            observation: the policy's image; None leaves that pane out.
            title: what stands before the time and the outcome.
        """
        camera = [
            Pane(np.asarray(self.coloured(rover)), "onboard camera"),
            Pane(np.asarray(self.segmented(rover)), "segmentation"),
        ]
        if observation is not None:
            camera.append(Pane(observation, observation_caption(self._env)))
        scene = scene_map(self._env, rover.scene)
        above = top_view_frame(scene, trail_xy_m, float(yaw_rad(rover.physics.qpos)))
        status = layout.OUTCOME_NAMES[Outcome(int(rover.outcome))]
        label = f"{title}   {int(rover.num_decisions) * self._env.dt:3.0f} s   {status}"
        size_m = 2 * scene.map_half_size_m
        return compose_frame([camera, [Pane(above, f"map, {size_m:g} m")]], title=label.lstrip())


def scene_map(env: RoverEnv, scene: Scene) -> SceneMap:
    """A scene from above."""
    return SceneMap(
        start_xy_m=np.asarray(env.config.scene.start_xy_m),
        goal_xy_m=np.asarray(scene.goal_xy_m),
        rock_xy_m=np.asarray(scene.rock_xy_m),
        rock_radius_m=env.rocks.radius_m[np.asarray(scene.rock_shape)],
        map_half_size_m=env.config.scene.map_size_m / 2,
        collision_radius_m=env.config.task.collision_radius_m,
        goal_radius_m=env.config.task.goal_radius_m,
    )


def camera_view(env: RoverEnv, kind: ObservationKind) -> Callable[[RoverState], UInt8[Array, "H W 3"]]:
    """A jitted function from a state to the whole camera image, (360, 640, 3) uint8, in colour or segmented.

    Under the scene's own conditions, but for exposure and what is drawn for each frame anew.
    """
    size = {"width_px": VIEW_WIDTH_PX, "height_px": VIEW_HEIGHT_PX, "scale": 1.0}
    # Neutral conditions ask nothing of renderer or rocks that this image does not need.
    config = replace_fields(env.config, obs=kind, conditions=ConditionsConfig(), **size)
    renderer = make_renderer(config, np.arange(VIEW_HEIGHT_PX), np.arange(VIEW_WIDTH_PX))
    smaller = VIEW_WIDTH_PX / env.config.camera.width_px

    def draw(rover: RoverState) -> UInt8[Array, "H W 3"]:
        camera = env.camera(rover)
        if kind == "rgb":
            return renderer.rgb(rover.scene, camera)
        border = rover.scene.conditions.border_px
        of_view = None if border is None else smaller * border
        conditions = dataclasses.replace(rover.scene.conditions, border_px=of_view)
        return jnp.asarray(PALETTE)[renderer.classes(dataclasses.replace(rover.scene, conditions=conditions), camera)]

    return jax.jit(draw)


def observation_caption(env: RoverEnv) -> str:
    """What stands over the policy's image."""
    rows, columns, _ = env.observation_shape
    return f"what the policy sees, {columns} x {rows}"

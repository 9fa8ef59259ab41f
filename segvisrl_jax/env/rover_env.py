"""``RoverEnv``: scene, physics, task and camera composed into ``reset(key)`` and ``step(state, action)``."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Bool, Int32, PRNGKeyArray, Shaped, UInt8, UInt32

from segvisrl_jax.config import (
    IMAGE_OBSERVATIONS,
    EngineName,
    EnvConfig,
    ObservationKind,
    RendererName,
    replace_fields,
    require,
)
from segvisrl_jax.env import model, rocks, task
from segvisrl_jax.env.conditions import (
    first_memory,
    frame_key,
    frame_words,
    moved_mount,
    next_memory,
    seen_frame,
    segmented_scene,
    wheel_shares,
    with_conditions,
)
from segvisrl_jax.env.physics import make_engine
from segvisrl_jax.env.pose import camera_mount, camera_pose, up_z
from segvisrl_jax.env.scene import sample_scene
from segvisrl_jax.env.vector import vector_observation, vector_size
from segvisrl_jax.types import (
    Action,
    CameraPose,
    Frame,
    Observation,
    Outcome,
    PhysicsState,
    RewardTerms,
    RoverState,
    Scene,
    StepResult,
)
from segvisrl_jax.vision.batching import one_by_one_on_cpu
from segvisrl_jax.vision.classes import PALETTE
from segvisrl_jax.vision.conditions import developed, flipped, is_random
from segvisrl_jax.vision.renderer import InGraphRenderer, Renderer, make_renderer
from segvisrl_jax.vision.resample import colour_and_resample, resample_taps, tap_plan

FrameWords = UInt32[Array, "6"] | None  # None where nothing in a frame is random
Look = Callable[[Scene, CameraPose, FrameWords], UInt8[Array, "H W 3"]]


class RoverEnv(Env):
    """Drive to the goal, around the rocks, from the camera (paper, section III).

    Observation:
        ``segmentation``: (H, W, 3) uint8, four classes in ``vision.classes.PALETTE``'s colours, bicubically shrunk.
        ``rgb``: (H, W, 3) uint8, colour, only shrunk.
        ``state``: (7,) float32: goal in the rover's frame over the largest goal distance (x, y), sine and cosine of
        the heading, forward and sideways speed over the top speed, turn rate over 0.5 rad/s.
        ``state_and_rocks``: (31,) float32: ``state``, then for each of the 8 nearest rocks within 6 m, the nearest
        first: its direction in the rover's frame (x, y), and the collision radius over its distance, which is 1
        where the episode ends. Zeros where there are fewer.
    Action: (2,) float32, left and right wheel speed as a share of the top speed, clipped to [0, 1]. No reverse.
    Reward: see ``env.task``; one decision a second, judged every 0.2 s.
    Termination: success, collision, fall, or physics that diverged. Truncation: the time limit.
    Reset: a fresh scene for every key.
    Conditions: ``config.conditions`` shifts what is seen and how wheels follow; ``scene.conditions`` holds the values.

    ``reset`` and ``step`` are for one environment; ``jax.jit`` and ``jax.vmap`` them. Training goes through
    ``initial_state``, ``advance`` and ``observe``, so that an automatic reset draws one image and not two.
    """

    def __init__(self, config: EnvConfig):
        """Builds physics and renderer.

        Raises:
            ConfigError: where the engine or the renderer cannot run here.
        """
        self.config = config
        self.engine = make_engine(config)
        self.rocks = rocks.rock_library(config.scene)
        self._mount = camera_mount(self.mj_model)
        camera = config.camera
        self._plan = tap_plan(camera.height_px, camera.width_px, camera.scale)
        self.renderer = self._look = None
        if config.obs in IMAGE_OBSERVATIONS:
            rows, self._row_taps = np.unique(self._plan.rows, return_inverse=True)
            columns, self._column_taps = np.unique(self._plan.columns, return_inverse=True)
            self.renderer = make_renderer(config, rows, columns)
            self._look = self._make_look(self.renderer)

    # brax's contract

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Shape of one observation."""
        return observation_shape(self.config)

    @property
    def observation_size(self) -> Any:
        """brax's notion of it: the length of a vector, the shape of an image."""
        return self.observation_shape if self._look else self.observation_shape[0]

    @property
    def action_size(self) -> int:
        """Two: left and right."""
        return 2

    @property
    def backend(self) -> str:
        """Name of the physics engine."""
        return self.engine.name

    @property
    def dt(self) -> float:
        """Time between two decisions, in seconds."""
        return self.config.task.decision_dt_s

    def reset(self, rng: PRNGKeyArray) -> State:
        """A new episode on a scene drawn from the key. Unbatched."""
        rover = self.initial_state(rng)
        zero = jnp.float32(0.0)
        metrics = _metrics(StepResult(zero, _no_reward(), zero, zero), rover.outcome)
        return State(rover, self.observe(rover), zero, zero, metrics, {"truncation": zero})

    def step(self, state: State, action: Action) -> State:
        """One decision. ``done`` is terminated or truncated; ``info["truncation"]`` tells the two apart."""
        rover, result = self.advance(state.pipeline_state, jnp.asarray(action, jnp.float32))  # a list, too
        done = jnp.maximum(result.terminated, result.truncated)
        metrics = {**state.metrics, **_metrics(result, rover.outcome)}
        info = {**state.info, "truncation": result.truncated}
        return State(rover, self.observe(rover), result.reward, done, metrics, info)

    # the parts that training composes in its own order

    def initial_state(self, key: PRNGKeyArray) -> RoverState:
        """The start of an episode on a scene drawn from the key (``sample_scene``), not looked at. Unbatched."""
        scene = sample_scene(key, self.config.scene, self.rocks)
        return self.state_on(with_conditions(key, scene, self.config))

    def state_on(self, scene: Scene) -> RoverState:
        """The start of an episode on a given scene, under the scene's own conditions. Unbatched."""
        start = jnp.asarray(self.config.scene.start_xy_m, jnp.float32)
        clearance = task.rock_clearance_m(start[None], scene)[0]
        physics = self.engine.place(start, scene.start_yaw_rad)
        return RoverState(
            physics=physics,
            scene=scene,
            num_decisions=jnp.int32(0),
            outcome=jnp.int32(Outcome.RUNNING),
            path_length_m=jnp.float32(0.0),
            min_clearance_m=clearance,
            episode_return=jnp.float32(0.0),
            **first_memory(physics, scene),  # type: ignore[arg-type]
        )

    def advance(self, state: RoverState, action: Action) -> tuple[RoverState, StepResult]:
        """One decision of physics and task, without looking. Unbatched.

        A state whose physics diverged keeps its last finite coordinates and gets the outcome ``UNSTABLE``.

        Raises:
            ConfigError: where the action is not of shape (2,).
        """
        shape = jnp.shape(action)
        require(shape == (2,), "action", f"of shape {shape}", "of shape (2,); jax.vmap or BatchEnv drive many at once")
        num_decisions = state.num_decisions + jnp.int32(1)
        judged = self.engine.advance(state.physics, wheel_shares(state, action, self.config.task))
        track = _track(judged)
        start_xy = state.physics.qpos[:2]
        rules = self.config.scene
        verdict = task.judge(start_xy, track, state.scene, num_decisions, self.config.task, rules)

        ended = jax.tree.map(lambda leaf: leaf[verdict.last], judged)
        is_sound = verdict.outcome != Outcome.UNSTABLE
        physics = jax.tree.map(lambda new, old: jnp.where(is_sound, new, old), ended, state.physics)
        reward = verdict.terms.total()
        truncated = verdict.outcome == Outcome.TIMEOUT
        terminated = (verdict.outcome != Outcome.RUNNING) & ~truncated
        rover = RoverState(
            physics=physics,
            scene=state.scene,
            num_decisions=num_decisions,
            outcome=verdict.outcome,
            path_length_m=state.path_length_m + verdict.path_length_m,
            min_clearance_m=jnp.minimum(state.min_clearance_m, verdict.min_clearance_m),
            episode_return=state.episode_return + reward,
            **next_memory(state, action, physics, num_decisions),  # type: ignore[arg-type]
        )
        as_float = jnp.float32
        return rover, StepResult(reward, verdict.terms, terminated.astype(as_float), truncated.astype(as_float))

    def observe(self, state: RoverState) -> Observation:
        """What the agent sees now. Unbatched."""
        if self._look is not None:
            scene, frame = state.scene, seen_frame(state)
            words = frame_words(scene, frame) if is_random(scene.conditions) else None
            return self._look(scene, self._camera_at(frame, scene), words)
        return vector_observation(state, self.config)

    def camera(self, state: RoverState) -> CameraPose:
        """Where the camera is and how it looks. Unbatched."""
        return self._camera_at(state.physics, state.scene)

    def _camera_at(self, place: PhysicsState | Frame, scene: Scene) -> CameraPose:
        return camera_pose(place, moved_mount(self._mount, scene.conditions))

    def _make_look(self, renderer: Renderer) -> Look:
        """What draws and shrinks one image."""

        def colours(scene: Scene, camera: CameraPose, words: FrameWords) -> UInt8[Array, "H W 3"]:
            drawn = developed(_key_of(words), renderer.rgb(scene, camera), scene.conditions)
            return resample_taps(self._taps(drawn), self._plan)

        def classes(scene: Scene, camera: CameraPose, words: FrameWords) -> UInt8[Array, "H W 3"]:
            key, conditions = _key_of(words), scene.conditions
            scene = segmented_scene(key, scene, camera, self.config)
            drawn, is_plain = flipped(key, *_classes(renderer, scene, camera), conditions)
            plain_taps = None if is_plain is None else is_plain[self._row_taps]
            return colour_and_resample(self._taps(drawn), self._plan, PALETTE, plain_taps)

        look = colours if self.config.obs == "rgb" else classes
        return one_by_one_on_cpu(look) if isinstance(renderer, InGraphRenderer) else look

    def _taps(self, drawn: Shaped[Array, "rows columns ..."]) -> Shaped[Array, "taps_h taps_w ..."]:
        """Rows and columns that downsampling reads more than once (at the border, and everywhere below scale 4)."""
        if drawn.shape[:2] == self._plan.tap_size:
            return drawn
        return drawn[self._row_taps][:, self._column_taps]

    # MuJoCo's view of it

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """The full MuJoCo model: rover, ground, every rock of the library, the goal."""
        return model.build_model(self.config)

    def to_mujoco(self, state: State | RoverState) -> mujoco.MjData:
        """One (unbatched) state as MuJoCo data of ``mj_model``, so that any MuJoCo tool can look at it."""
        rover = state.pipeline_state if isinstance(state, State) else state
        data = mujoco.MjData(self.mj_model)
        arrays: RoverState = jax.tree.map(np.asarray, rover)
        model.set_mujoco_state(self.mj_model, data, arrays.physics, arrays.scene)
        return data


def make_env(
    obs: ObservationKind = "segmentation",
    scale: float = 10,
    renderer: RendererName = "auto",
    physics: EngineName = "auto",
    num_rocks: int = 4,
    **fields: Any,
) -> RoverEnv:
    """Builds an environment.

    Args:
        obs: ``segmentation``, ``rgb``, ``state`` or ``state_and_rocks``.
        scale: bicubic downsampling per axis.
        renderer: ``auto`` (``scanline``), ``scanline``, ``gl`` or ``warp``.
        physics: ``auto``, ``native`` or ``mjx``.
        num_rocks: rocks on the map.
        **fields: any other field of ``EnvConfig`` or of its parts, by its name, e.g. ``goal_distance_max_m=20``.

    Raises:
        ConfigError: for a setting that does not exist or cannot be used.
    """
    return RoverEnv(env_config(obs, scale, renderer, physics, num_rocks, **fields))


def env_config(
    obs: ObservationKind = "segmentation",
    scale: float = 10,
    renderer: RendererName = "auto",
    physics: EngineName = "auto",
    num_rocks: int = 4,
    **fields: Any,
) -> EnvConfig:
    """The settings of ``make_env``, without building anything."""
    scale = float(scale) if isinstance(scale, int) else scale
    named: dict[str, Any] = {
        "obs": obs,
        "scale": scale,
        "renderer": renderer,
        "engine": physics,
        "num_rocks": num_rocks,
    }
    return replace_fields(EnvConfig(), **named, **fields)


def observation_shape(config: EnvConfig) -> tuple[int, ...]:
    """Shape of one observation, without building the environment."""
    if config.obs in IMAGE_OBSERVATIONS:
        return (*config.camera.observation_size_px, 3)
    return (vector_size(config.obs),)


def _key_of(words: FrameWords) -> PRNGKeyArray:
    """The key of a frame's randomness; any key where nothing is random."""
    return jax.random.key(0) if words is None else frame_key(words)


def _classes(
    renderer: Renderer, scene: Scene, camera: CameraPose
) -> tuple[UInt8[Array, "rows columns"], Bool[Array, "rows"] | None]:
    """Class ids, and which rows show one class only, where the renderer knows."""
    if isinstance(renderer, InGraphRenderer):
        return renderer.classes_and_plain_rows(scene, camera)
    return renderer.classes(scene, camera), None


def _track(judged: PhysicsState) -> task.Track:
    is_finite = jnp.all(jnp.isfinite(judged.qpos), axis=-1) & jnp.all(jnp.isfinite(judged.qvel), axis=-1)
    return task.Track(xy_m=judged.qpos[:, :2], up_z=jax.vmap(up_z)(judged.qpos), is_finite=is_finite)


def _no_reward() -> RewardTerms:
    return RewardTerms(**{field.name: jnp.float32(0.0) for field in dataclasses.fields(RewardTerms)})


def _metrics(result: StepResult, outcome: Int32[Array, ""]) -> dict[str, Array]:
    """brax's metrics: the same fields after reset and after step."""
    terms = {f"reward/{name}": term for name, term in result.terms.by_name().items()}
    ended = {
        f"outcome/{kind.name.lower()}": (outcome == kind).astype(jnp.float32)
        for kind in Outcome
        if kind != Outcome.RUNNING
    }
    return {**terms, **ended}

"""``RoverEnv``: scene, physics, task and camera composed into ``reset(key)`` and ``step(state, action)``."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Float32, Int32, PRNGKeyArray, UInt8

from segvisrl_jax.config import IMAGE_OBSERVATIONS, EngineName, EnvConfig, ObservationKind, RendererName, replace_fields
from segvisrl_jax.env import model, rocks, task
from segvisrl_jax.env.physics import make_engine
from segvisrl_jax.env.pose import camera_mount, camera_pose, in_rover_frame, up_z, yaw_rad
from segvisrl_jax.env.scene import sample_scene
from segvisrl_jax.types import (
    Action,
    CameraPose,
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
from segvisrl_jax.vision.renderer import InGraphRenderer, Renderer, make_renderer
from segvisrl_jax.vision.resample import colour_and_resample, resample_taps, tap_plan

TYPICAL_TURN_RATE_RAD_S = 0.5  # scales the turn rate in the state observation to about 1
STATE_SIZE = 7
NUM_NEAREST_ROCKS = 8  # that a vector holds: at 64 rocks on the map, those within 5 m
ROCK_SIZE = 3  # forward, left, closeness
ROCK_RANGE_M = 6.0  # rocks beyond are left out: half a minute's drive
ROCK_SCALE_M = 4.0  # scales a rock's place to about 1


class RoverEnv(Env):
    """Drive to the goal, around the rocks, from the camera (paper, section III).

    Observation:
        ``segmentation``: (H, W, 3) uint8, four classes in ``vision.classes.PALETTE``'s colours, bicubically shrunk.
        ``rgb``: (H, W, 3) uint8, colour, only shrunk.
        ``state``: (7,) float32: goal in the rover's frame over the largest goal distance (x, y), sine and cosine of
        the heading, forward and sideways speed over the top speed, turn rate over 0.5 rad/s.
        ``state_and_rocks``: (31,) float32: ``state``, then for each of the 8 nearest rocks within 6 m, the nearest
        first: its centre in the rover's frame over 4 m (x, y), and the collision radius over its distance, which is 1
        where the episode ends. Zeros where there are fewer.
    Action: (2,) float32, left and right wheel speed as a share of the top speed, clipped to [0, 1]. No reverse.
    Reward: see ``env.task``; one decision a second, judged every 0.2 s.
    Termination: success, collision, fall, or physics that diverged. Truncation: the time limit.
    Reset: a fresh scene for every key.

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
        rover, result = self.advance(state.pipeline_state, action)
        done = jnp.maximum(result.terminated, result.truncated)
        metrics = {**state.metrics, **_metrics(result, rover.outcome)}
        info = {**state.info, "truncation": result.truncated}
        return State(rover, self.observe(rover), result.reward, done, metrics, info)

    # the parts that training composes in its own order

    def initial_state(self, key: PRNGKeyArray) -> RoverState:
        """The start of an episode on a scene drawn from the key, without looking at it. Unbatched."""
        scene = sample_scene(key, self.config.scene, self.rocks)
        return self.state_on(scene)

    def state_on(self, scene: Scene) -> RoverState:
        """The start of an episode on a given scene. Unbatched."""
        start = jnp.asarray(self.config.scene.start_xy_m, jnp.float32)
        clearance = task.rock_clearance_m(start[None], scene)[0]
        return RoverState(
            physics=self.engine.place(start, scene.start_yaw_rad),
            scene=scene,
            num_decisions=jnp.int32(0),
            outcome=jnp.int32(Outcome.RUNNING),
            path_length_m=jnp.float32(0.0),
            min_clearance_m=clearance,
            episode_return=jnp.float32(0.0),
        )

    def advance(self, state: RoverState, action: Action) -> tuple[RoverState, StepResult]:
        """One decision of physics and task, without looking. Unbatched.

        A state whose physics diverged keeps its last finite coordinates and gets the outcome ``UNSTABLE``.
        """
        num_decisions = state.num_decisions + jnp.int32(1)
        judged = self.engine.advance(state.physics, action)
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
        )
        as_float = jnp.float32
        return rover, StepResult(reward, verdict.terms, terminated.astype(as_float), truncated.astype(as_float))

    def observe(self, state: RoverState) -> Observation:
        """What the agent sees now. Unbatched."""
        if self._look is not None:
            return self._look(state.scene, self.camera(state))
        vector = self._state_vector(state)
        return jnp.append(vector, self._rock_vector(state)) if self.config.obs == "state_and_rocks" else vector

    def camera(self, state: RoverState) -> CameraPose:
        """Where the camera is and how it looks. Unbatched."""
        return camera_pose(state.physics, self._mount)

    def _make_look(self, renderer: Renderer) -> Callable[[Scene, CameraPose], UInt8[Array, "H W 3"]]:
        """What draws and shrinks one image."""

        def colours(scene: Scene, camera: CameraPose) -> UInt8[Array, "H W 3"]:
            return resample_taps(self._taps(renderer.rgb(scene, camera)), self._plan)

        def classes(scene: Scene, camera: CameraPose) -> UInt8[Array, "H W 3"]:
            if not isinstance(renderer, InGraphRenderer):
                return colour_and_resample(self._taps(renderer.classes(scene, camera)), self._plan, PALETTE)
            drawn, is_plain = renderer.classes_and_plain_rows(scene, camera)
            return colour_and_resample(self._taps(drawn), self._plan, PALETTE, is_plain[self._row_taps])

        look = colours if self.config.obs == "rgb" else classes
        return one_by_one_on_cpu(look) if isinstance(renderer, InGraphRenderer) else look

    def _taps(self, drawn: UInt8[Array, "rows columns ..."]) -> UInt8[Array, "taps_h taps_w ..."]:
        """Rows and columns that downsampling reads more than once (at the border, and everywhere below scale 4)."""
        if drawn.shape[:2] == self._plan.tap_size:
            return drawn
        return drawn[self._row_taps][:, self._column_taps]

    def _state_vector(self, state: RoverState) -> Float32[Array, "7"]:
        qpos, qvel = state.physics.qpos, state.physics.qvel
        heading = yaw_rad(qpos)
        goal = in_rover_frame(state.scene.goal_xy_m - qpos[:2], heading)
        velocity = in_rover_frame(qvel[:2], heading)
        parts = [
            goal / self.config.scene.goal_distance_max_m,
            jnp.stack([jnp.sin(heading), jnp.cos(heading)]),
            velocity / self.config.physics.top_speed_m_s,
            qvel[5:6] / TYPICAL_TURN_RATE_RAD_S,
        ]
        return jnp.concatenate(parts).astype(jnp.float32)

    def _rock_vector(self, state: RoverState) -> Float32[Array, "D"]:
        """The nearest rocks, 3 numbers each, zeros where there are fewer."""
        offset = state.scene.rock_xy_m - state.physics.qpos[:2]
        nearness, order = jax.lax.top_k(-jnp.linalg.norm(offset, axis=-1), min(NUM_NEAREST_ROCKS, len(offset)))
        distance = -nearness[:, None]
        place = jax.vmap(in_rover_frame, in_axes=(0, None))(offset[order], yaw_rad(state.physics.qpos))
        limit = self.config.task.collision_radius_m
        rocks = jnp.concatenate([place / ROCK_SCALE_M, limit / jnp.maximum(distance, limit)], axis=-1)
        seen = jnp.where(distance <= ROCK_RANGE_M, rocks, 0.0)
        return jnp.pad(seen.ravel(), (0, NUM_NEAREST_ROCKS * ROCK_SIZE - seen.size)).astype(jnp.float32)

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
    scale = float(scale) if isinstance(scale, int) else scale
    named: dict[str, Any] = {
        "obs": obs,
        "scale": scale,
        "renderer": renderer,
        "engine": physics,
        "num_rocks": num_rocks,
    }
    return RoverEnv(replace_fields(EnvConfig(), **named, **fields))


def observation_shape(config: EnvConfig) -> tuple[int, ...]:
    """Shape of one observation, without building the environment."""
    if config.obs in IMAGE_OBSERVATIONS:
        return (*config.camera.observation_size_px, 3)
    num_rocks = NUM_NEAREST_ROCKS if config.obs == "state_and_rocks" else 0
    return (STATE_SIZE + num_rocks * ROCK_SIZE,)


def _track(judged: PhysicsState) -> task.Track:
    is_finite = jnp.all(jnp.isfinite(judged.qpos), axis=-1) & jnp.all(jnp.isfinite(judged.qvel), axis=-1)
    return task.Track(xy_m=judged.qpos[:, :2], up_z=jax.vmap(up_z)(judged.qpos), is_finite=is_finite)


def _no_reward() -> RewardTerms:
    zero = jnp.float32(0.0)
    return RewardTerms(zero, zero, zero, zero)


def _metrics(result: StepResult, outcome: Int32[Array, ""]) -> dict[str, Array]:
    """brax's metrics: the same fields after reset and after step."""
    terms = {f"reward/{name}": getattr(result.terms, name) for name in ("progress", "collision", "fall", "timeout")}
    ended = {
        f"outcome/{kind.name.lower()}": (outcome == kind).astype(jnp.float32)
        for kind in Outcome
        if kind != Outcome.RUNNING
    }
    return {**terms, **ended}

"""``RoverEnv`` as Gymnasium sees environments: one, or many in one compiled program.

``import segvisrl_jax`` registers both, so that ``gymnasium.make("segvisrl_jax/LunarRover-v0")`` and
``gymnasium.make_vec("segvisrl_jax/LunarRover-v0", num_envs=32)`` find them. Keywords are those of ``make_env``.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float32, Float64, UInt8

from segvisrl_jax.config import IMAGE_OBSERVATIONS, EnvConfig, require
from segvisrl_jax.env.rover_env import RoverEnv, env_config, make_env
from segvisrl_jax.env.wrappers import TEST_STREAM, BatchEnv, BatchState, scene_stream
from segvisrl_jax.report.episode import EpisodeView
from segvisrl_jax.types import Action, Outcome, RoverState

RENDER_FPS = 8  # eight decisions, so eight simulated seconds, in each second of video
SCENE_OPTION = "scene"
LARGEST_KEY_SEED = 2**31 - 1
ObservationArray = UInt8[np.ndarray, "*B H W 3"] | Float32[np.ndarray, "*B D"]
ActionArray = np.ndarray  # (*B, 2): whatever agents give is converted to float32


class LunarRover(gymnasium.Env[ObservationArray, ActionArray]):
    """One rover: reach the goal, around the rocks, from the camera. See ``RoverEnv`` for the task.

    Observation: a ``Box`` of ``RoverEnv.observation_shape``: uint8 in [0, 255] for images, float32 for vectors.
    Action: ``Box(0, 1, (2,), float32)``: left and right wheel speed as a share of the top speed.
    Info: ``is_success``, ``outcome`` (a name), ``path_length_m``, ``min_clearance_m`` (inf without rocks).

    ``reset(seed=n)`` seeds all scenes that follow; ``reset(options={"scene": i})`` starts on test scene i of
    ``segvisrl eval --seed 0``, the same for everyone. The time limit is the environment's own (``truncated``).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS}  # noqa: RUF012  as Gymnasium declares it

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        """Builds the environment.

        Args:
            render_mode: ``rgb_array`` or None.
            **settings: of ``make_env``, e.g. ``obs="rgb"``, ``scale=20``, ``num_rocks=16``.

        Raises:
            ConfigError: for a mode or a setting that does not exist or cannot be used.
        """
        _require_mode(render_mode)
        self.render_mode = render_mode
        compiled = _compile(env_config(**settings))
        self.rover_env, self._start, self._advance = compiled
        self.observation_space = _observation_space(self.rover_env)
        self.action_space = _action_space()
        self._rover: RoverState | None = None
        self._observation: ObservationArray | None = None
        self._trail = _Trail(self.rover_env) if render_mode else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationArray, dict[str, Any]]:
        """A new episode: on a scene drawn from the environment's generator, or on a numbered test scene.

        Raises:
            ConfigError: for an option that does not exist, or a scene's number that is not a whole one.
        """
        super().reset(seed=seed)
        number = _scene_option(options)
        drawn = jax.random.key(int(self.np_random.integers(LARGEST_KEY_SEED)))
        key = drawn if number is None else jax.random.fold_in(scene_stream(0, TEST_STREAM), number)
        rover, observation = jax.device_get(self._start(key))
        return self._seen(rover, observation, is_start=True), _info(rover)

    def step(self, action: ActionArray) -> tuple[ObservationArray, float, bool, bool, dict[str, Any]]:
        """One decision.

        Raises:
            gymnasium.error.ResetNeeded: before the first ``reset``, and after the end of an episode.
        """
        if self._rover is None or self._rover.outcome != Outcome.RUNNING:
            raise gymnasium.error.ResetNeeded("the episode has ended, or none has begun: call reset()")
        after = self._advance(self._rover, np.asarray(action, np.float32))
        rover, observation, result = jax.device_get(after)
        seen = self._seen(rover, observation, is_start=False)
        return seen, float(result.reward), bool(result.terminated), bool(result.truncated), _info(rover)

    def render(self) -> UInt8[np.ndarray, "H W 3"] | None:  # type: ignore[override]
        """Camera, segmentation, what the policy sees, and the map with the trail; None without a render mode."""
        if self._trail is None or self._rover is None:
            return None
        return self._trail.draw(self._rover, self._observation)

    def _seen(self, rover: RoverState, observation: ObservationArray, is_start: bool) -> ObservationArray:
        """Keeps where the rover is."""
        self._rover, self._observation = rover, observation
        if self._trail:
            self._trail.add(rover, is_start)
        return np.array(observation)  # a copy of its own


class LunarRoverVector(gymnasium.vector.VectorEnv[ObservationArray, ActionArray, np.ndarray]):
    """B rovers in one compiled program, each of which starts on a fresh scene in the step that ends its episode.

    Spaces are ``LunarRover``'s, batched. As in Gymnasium's own vector environments with ``AutoresetMode.SAME_STEP``:
    where episodes ended, ``infos["final_obs"]`` (an object array, None elsewhere) and ``infos["final_info"]`` hold what
    was seen and known before the reset, with masks ``_final_obs`` and ``_final_info``.
    """

    metadata = {  # noqa: RUF012  as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": RENDER_FPS,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(self, num_envs: int = 1, render_mode: str | None = None, **settings: Any) -> None:
        """Builds the environments.

        Args:
            num_envs: B.
            render_mode: ``rgb_array`` or None.
            **settings: of ``make_env``.

        Raises:
            ConfigError: for a mode, a number or a setting that does not exist or cannot be used.
        """
        _require_mode(render_mode)
        require(isinstance(num_envs, int) and num_envs >= 1, "num_envs", num_envs, "a whole number, 1 or more")
        self.render_mode = render_mode
        self.num_envs = num_envs
        self.rover_env = make_env(**settings)
        self.single_observation_space = _observation_space(self.rover_env)
        self.single_action_space = _action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._batch = BatchEnv(self.rover_env, num_envs)
        self._start = jax.jit(functools.partial(_start_all, self._batch))
        self._advance = jax.jit(functools.partial(_advance_all, self._batch))
        self._state: BatchState | None = None
        self._observations: ObservationArray | None = None
        self._trails = [_Trail(self.rover_env) for _ in range(num_envs)] if render_mode else []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationArray, dict[str, Any]]:
        """B new episodes; the seed determines all scenes that follow.

        Raises:
            ConfigError: for options: there are none.
        """
        require(not options, "options", options, "empty: a vector of environments has none")
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(LARGEST_KEY_SEED)))
        self._state, observations = self._start(key)
        rover, self._observations = jax.device_get((self._state.rover, observations))
        self._follow(rover, np.ones(self.num_envs, bool))
        return np.array(self._observations), _masked(_info(rover), np.ones(self.num_envs, bool))

    def step(
        self, actions: ActionArray
    ) -> tuple[ObservationArray, Float64[np.ndarray, "B"], Bool[np.ndarray, "B"], Bool[np.ndarray, "B"], dict]:
        """One decision of every rover.

        Raises:
            gymnasium.error.ResetNeeded: before the first ``reset``.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset()")
        self._state, told = self._advance(self._state, np.asarray(actions, np.float32))
        rover, result, observations, final = jax.device_get((self._state.rover, *told))
        self._observations = observations
        done = np.asarray(result.done, bool)
        self._follow(rover, done)
        infos = _masked(_info(rover), np.ones(self.num_envs, bool))
        if done.any():
            infos |= {"final_obs": _objects(final, done), "_final_obs": done.copy()}
            infos |= {"final_info": _masked(_info(result.rover), done), "_final_info": done.copy()}
        reward = np.asarray(result.reward, np.float64)
        terminated, truncated = (np.asarray(ended, bool) for ended in (result.terminated, result.truncated))
        return np.array(observations), reward, terminated, truncated, infos

    def render(self) -> tuple[UInt8[np.ndarray, "H W 3"], ...] | None:
        """One frame for each rover, as of ``LunarRover.render``; None without a render mode."""
        if not self._trails or self._state is None or self._observations is None:
            return None
        rovers = jax.device_get(self._state.rover)
        places = enumerate(zip(self._trails, self._observations, strict=True))
        return tuple(trail.draw(_one(rovers, place), seen) for place, (trail, seen) in places)

    def _follow(self, rovers: RoverState, is_start: Bool[np.ndarray, "B"]) -> None:
        for place, trail in enumerate(self._trails):
            trail.add(_one(rovers, place), bool(is_start[place]))


class _Trail:
    """Where one rover has been in this episode, and its picture."""

    def __init__(self, env: RoverEnv) -> None:
        self._sees_images = env.config.obs in IMAGE_OBSERVATIONS
        self._view = EpisodeView(env)
        self._xy_m: list[np.ndarray] = []

    def add(self, rover: RoverState, is_start: bool) -> None:
        self._xy_m = [*([] if is_start else self._xy_m), np.asarray(rover.physics.qpos[:2])]

    def draw(self, rover: RoverState, observation: ObservationArray | None) -> UInt8[np.ndarray, "H W 3"]:
        return self._view(rover, np.stack(self._xy_m), observation if self._sees_images else None)


# what is compiled


class _Compiled(NamedTuple):
    """An environment and its two functions, which all rovers of the same settings share."""

    env: RoverEnv
    start: Callable
    advance: Callable


@functools.lru_cache(maxsize=8)
def _compile(config: EnvConfig) -> _Compiled:
    """Vectors of single environments, as Gymnasium and others make them, would else compile each one anew."""
    env = RoverEnv(config)
    return _Compiled(env, jax.jit(functools.partial(_start, env)), jax.jit(functools.partial(_advance, env)))


def _start(env: RoverEnv, key):
    rover = env.initial_state(key)
    return rover, env.observe(rover)


def _advance(env: RoverEnv, rover: RoverState, action: Action):
    after, result = env.advance(rover, action)
    return after, env.observe(after), result


def _start_all(batch: BatchEnv, key):
    state = batch.reset(key)
    return state, batch.observe(state)


def _advance_all(batch: BatchEnv, state: BatchState, actions: Action):
    """The next state; and what happened, what is seen now, and what those saw last whose episodes ended."""
    after, result = batch.step(state, actions)
    seen = batch.observe(after)
    look = jax.vmap(batch.env.observe)
    final = jax.lax.cond(jnp.any(result.done > 0), look, lambda _: jnp.zeros_like(seen), result.rover)
    return after, (result, seen, final)


# what Gymnasium asks for


def _observation_space(env: RoverEnv) -> gymnasium.spaces.Box:
    if env.config.obs in IMAGE_OBSERVATIONS:
        return gymnasium.spaces.Box(0, 255, env.observation_shape, np.uint8)
    return gymnasium.spaces.Box(-np.inf, np.inf, env.observation_shape, np.float32)


def _action_space() -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(0.0, 1.0, (2,), np.float32)


def _require_mode(render_mode: str | None) -> None:
    require(render_mode in (None, "rgb_array"), "render_mode", render_mode, "None or 'rgb_array'")


def _scene_option(options: dict[str, Any] | None) -> int | None:
    """The number of the test scene that is asked for."""
    options = options or {}
    unknown = sorted(set(options) - {SCENE_OPTION})
    require(not unknown, "options", unknown, f"among {SCENE_OPTION!r}")
    number = options.get(SCENE_OPTION)
    is_number = number is None or (isinstance(number, int | np.integer) and 0 <= number <= LARGEST_KEY_SEED)
    require(bool(is_number), f"options[{SCENE_OPTION!r}]", number, f"a whole number in [0, {LARGEST_KEY_SEED}]")
    return number


def _info(rover: RoverState) -> dict[str, Any]:
    """Of one rover, or arrays of B."""
    names = np.array([kind.name.lower() for kind in Outcome])
    info = {
        "is_success": np.asarray(rover.outcome) == Outcome.SUCCESS,
        "outcome": names[rover.outcome],
        "path_length_m": np.asarray(rover.path_length_m),
        "min_clearance_m": np.asarray(rover.min_clearance_m),
    }
    return info if np.ndim(rover.outcome) else {name: value.item() for name, value in info.items()}


def _masked(info: dict[str, np.ndarray], mask: Bool[np.ndarray, "B"]) -> dict[str, Any]:
    """Infos of B rovers with Gymnasium's masks of whom they are about."""
    return info | {f"_{name}": mask.copy() for name in info}


def _one(rovers: RoverState, place: int) -> RoverState:
    """One of B states."""
    return jax.tree.map(lambda leaf: leaf[place], rovers)


def _objects(values: Sequence[Any], mask: Bool[np.ndarray, "B"]) -> np.ndarray:
    """An object array: a value where the mask is set, else None."""
    found = np.full(len(mask), None, dtype=object)
    for place in np.flatnonzero(mask).tolist():
        found[place] = np.array(values[place])
    return found

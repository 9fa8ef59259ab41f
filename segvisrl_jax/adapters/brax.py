"""``RoverEnv`` as brax's own agents see environments: images as ``pixels/`` observations, fresh scenes after resets.

Importing this module registers ``segvis_rover``, so that ``brax.envs.get_environment("segvis_rover")`` finds it.

What brax's own wrappers do (``brax.envs.training.wrap``): ``AutoResetWrapper`` puts every environment back to its first
scene for ever, so that an agent in B environments sees B scenes until ``brax.training`` resets all of them
(``num_resets_per_eval``). ``wrap_with_fresh_scenes`` is the same but for a new scene after every episode; hand it to
brax as ``wrap_env_fn``. In both, ``EpisodeWrapper`` tells its own time limit from other ends in
``info["truncation"]``; the task's time limit ends an episode like any other end, as in this project's training.

brax 0.14's agents call ``jax.device_put_replicated``, which JAX 0.10 has taken away
(https://github.com/google/brax/issues/671): importing this module gives it back where it is missing.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax import envs
from brax.envs.base import Env, State, Wrapper
from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper
from jaxtyping import Array, PRNGKeyArray, UInt32

from segvisrl_jax.config import IMAGE_OBSERVATIONS, require
from segvisrl_jax.env.rover_env import make_env
from segvisrl_jax.env.wrappers import select
from segvisrl_jax.types import Action

BRAX_NAME = "segvis_rover"
PIXELS = "pixels/camera"  # brax's vision networks read whatever begins with pixels/
PIXEL_MAX = 255.0
SCENE_KEY = "scene_key"
AnyKey = PRNGKeyArray | UInt32[Array, "2"]


class SegvisRover(Env):
    """One rover, unbatched: ``RoverEnv`` with observations as brax's networks want them.

    Images are ``{"pixels/camera": (H, W, 3) float32 in [0, 1]}``, for ``make_ppo_networks_vision``; ``state`` and
    ``state_and_rocks`` are float32 vectors, for ``make_ppo_networks``.
    """

    def __init__(self, **settings: Any) -> None:
        """Builds it.

        Args:
            **settings: of ``make_env``, e.g. ``obs="state"``, ``scale=20``, ``num_rocks=16``.

        Raises:
            ConfigError: for a setting that does not exist or cannot be used.
        """
        self.rover_env = make_env(**settings)
        self._sees_images = self.rover_env.config.obs in IMAGE_OBSERVATIONS

    def reset(self, rng: AnyKey) -> State:
        """A new episode on a scene drawn from the key."""
        return self._as_brax(self.rover_env.reset(rng))

    def step(self, state: State, action: Action) -> State:
        """One decision."""
        return self._as_brax(self.rover_env.step(state, action))

    @property
    def observation_size(self) -> Any:
        """Shapes by name for images, the length for vectors."""
        shape = self.rover_env.observation_shape
        return {PIXELS: shape} if self._sees_images else shape[0]

    @property
    def action_size(self) -> int:
        """Two: left and right."""
        return self.rover_env.action_size

    @property
    def backend(self) -> str:
        """Name of the physics engine."""
        return self.rover_env.backend

    def _as_brax(self, state: State) -> State:
        if not self._sees_images:
            return state
        return state.replace(obs={PIXELS: jnp.asarray(state.obs, jnp.float32) / PIXEL_MAX})  # type: ignore[attr-defined]


def wrap_with_fresh_scenes(
    env: Env,
    episode_length: int,
    action_repeat: int = 1,
    randomization_fn: Callable[..., Any] | None = None,
) -> Wrapper:
    """``brax.envs.training.wrap``, but every episode has a scene of its own: ``train(..., wrap_env_fn=this)``.

    Args:
        env: unbatched.
        episode_length: at most so many decisions; the task's own limit is 100.
        action_repeat: 1. brax adds up rewards without a look at ``done``, so that an end would be paid for several
            times; ``SegvisRover(decision_dt_s=2.0)`` holds an action longer.
        randomization_fn: not used by this environment: conditions are drawn with the scene
            (``SegvisRover(randomize=True)``).

    Raises:
        ConfigError: for a ``randomization_fn``, or another ``action_repeat``.
    """
    require(action_repeat == 1, "action_repeat", action_repeat, "1: say decision_dt_s=2.0 to hold an action longer")
    require(randomization_fn is None, "randomization_fn", randomization_fn, "None: say randomize=True instead")
    return FreshScenesWrapper(EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat))


class FreshScenesWrapper(Wrapper):
    """Resets those of B environments that are done onto fresh scenes; goes around ``EpisodeWrapper``."""

    def reset(self, rng: AnyKey) -> State:
        """B episodes, each from its own key."""
        state = self.env.reset(rng)
        state.info[SCENE_KEY] = jax.vmap(lambda key: jax.random.fold_in(key, 1))(rng)
        return state

    def step(self, state: State, action: Action) -> State:
        """One decision of each, and a new start where it ended an episode."""
        steps = jnp.where(state.done, 0.0, state.info["steps"])
        begun = state.replace(done=jnp.zeros_like(state.done), info={**state.info, "steps": steps})  # type: ignore[attr-defined]
        after = self.env.step(begun, action)
        return jax.lax.cond(jnp.any(after.done > 0), self._with_fresh_scenes, lambda same: same, after)

    def _with_fresh_scenes(self, state: State) -> State:
        keys = jax.vmap(jax.random.split)(state.info[SCENE_KEY])
        start = jax.vmap(self.unwrapped.reset)(keys[:, 0])
        ended = state.done > 0
        return state.replace(  # type: ignore[attr-defined]
            pipeline_state=select(ended, start.pipeline_state, state.pipeline_state),
            obs=select(ended, start.obs, state.obs),
            info={**state.info, SCENE_KEY: select(ended, keys[:, 1], state.info[SCENE_KEY])},
        )


def _device_put_replicated(tree: Any, devices: Sequence[jax.Device]) -> Any:
    """A copy on every device, along a new first axis, as JAX's migration guide has it in place of what it removed
    (https://docs.jax.dev/en/latest/migrate_pmap.html)."""
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    return jax.tree.map(lambda leaf: jax.device_put(jnp.stack([leaf] * len(devices)), sharding), tree)


if not hasattr(jax, "device_put_replicated"):
    jax.device_put_replicated = _device_put_replicated  # type: ignore[assignment]
envs.register_environment(BRAX_NAME, SegvisRover)

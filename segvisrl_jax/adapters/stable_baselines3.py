"""Many rovers in one compiled program, as Stable-Baselines3 sees vectors of environments (extra ``[sb3]``).

``gymnasium.make`` works there too; this is for many environments at once::

    from stable_baselines3 import PPO
    from segvisrl_jax.adapters.stable_baselines3 import LunarRoverVecEnv

    PPO("CnnPolicy", LunarRoverVecEnv(16)).learn(100_000)

Its CNN policies want images of 36 x 36 pixels or more: ``scale=30`` or less.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Bool, Float32
from stable_baselines3.common.vec_env import VecEnv

from segvisrl_jax.adapters.gymnasium import ActionArray, LunarRoverVector, ObservationArray
from segvisrl_jax.config import require

Indices = int | Iterable[int] | None


class LunarRoverVecEnv(VecEnv):
    """B rovers; where an episode ends, the next observation is that of a fresh scene.

    Infos, one dict for each: ``is_success``, ``outcome``, ``path_length_m``, ``min_clearance_m``; at the end of an
    episode they are those of the end, with ``terminal_observation`` and ``TimeLimit.truncated``.
    """

    def __init__(self, num_envs: int = 16, render_mode: str | None = None, **settings: Any) -> None:
        """Builds them.

        Args:
            num_envs: B.
            render_mode: ``rgb_array`` or None.
            **settings: of ``make_env``.

        Raises:
            ConfigError: for a mode, a number or a setting that does not exist or cannot be used.
        """
        self.rovers = LunarRoverVector(num_envs, render_mode, **settings)
        self.metadata = self.rovers.metadata
        self._actions: ActionArray = np.zeros((num_envs, 2), np.float32)
        spaces = self.rovers.single_observation_space, self.rovers.single_action_space
        self.render_mode = render_mode
        super().__init__(num_envs, *spaces)

    def reset(self) -> ObservationArray:
        """B new episodes; the seed is that of ``seed``, where one was given."""
        observations, infos = self.rovers.reset(seed=self._seeds[0])
        self.reset_infos = [_of(infos, place) for place in range(self.num_envs)]
        self._reset_seeds()
        return observations

    def step_async(self, actions: ActionArray) -> None:
        """Keeps the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[ObservationArray, Float32[np.ndarray, "B"], Bool[np.ndarray, "B"], list[dict[str, Any]]]:
        """One decision of every rover."""
        observations, rewards, terminated, truncated, infos = self.rovers.step(self._actions)
        done = terminated | truncated
        told = [_of(infos, place) for place in range(self.num_envs)]
        for place in np.flatnonzero(done).tolist():
            told[place] = _of(infos["final_info"], place) | {
                "terminal_observation": infos["final_obs"][place],
                "TimeLimit.truncated": bool(truncated[place] and not terminated[place]),
            }
        return observations, rewards.astype(np.float32), done, told

    def get_images(self) -> Sequence[np.ndarray | None]:
        """One frame for each."""
        return self.rovers.render() or [None] * self.num_envs

    def close(self) -> None:
        """Nothing is held open."""

    def set_options(self, options: Any = None) -> None:
        """Refused: a vector of environments has none.

        Raises:
            ConfigError: for options.
        """
        require(not options, "options", options, "empty: a vector of environments has none")

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of the vector, once for each rover."""
        return [getattr(self.rovers, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Refused: rovers of one compiled program are alike."""
        raise AttributeError(f"{attr_name} cannot be set: build LunarRoverVecEnv with other settings")

    def env_method(self, method_name: str, *args: Any, indices: Indices = None, **keywords: Any) -> list[Any]:
        """Refused: there are no separate environments."""
        raise AttributeError(f"{method_name} cannot be called on one rover of a compiled vector")

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: Indices = None) -> list[bool]:
        """None is."""
        return [False] * len(list(self._get_indices(indices)))


def _of(infos: dict[str, Any], place: int) -> dict[str, Any]:
    """What is known of one rover."""
    return {name: infos[name][place].item() for name in ("is_success", "outcome", "path_length_m", "min_clearance_m")}

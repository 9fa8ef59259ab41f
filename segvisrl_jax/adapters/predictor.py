"""A trained policy with Stable-Baselines3's ``predict``: for loops over Gymnasium's environments, and for its tools."""

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, PRNGKeyArray, Shaped

from segvisrl_jax.agent.distributions import DiagonalGaussian
from segvisrl_jax.agent.memory import Carry
from segvisrl_jax.agent.networks import Network, Params
from segvisrl_jax.config import require
from segvisrl_jax.training.policy import load_network

State = tuple[Float32[np.ndarray, "B S"], ...]


class Predictor:
    """A policy by its folder or name, that remembers nothing by itself: ``predict`` takes its state and gives the next.

    It needs nothing of Stable-Baselines3, whose ``evaluate_policy`` takes it as a model.
    """

    def __init__(self, policy: Path | str, seed: int = 0) -> None:
        """Reads it.

        Args:
            policy: a policy's folder (``runs/NAME/policy``), or the name of a shipped one.
            seed: of the actions that are drawn, where they are.

        Raises:
            ConfigError: where it is missing or damaged; the message names the file.
        """
        self.config, self._network, params = load_network(Path(policy))
        self._params = jax.device_put(params)
        self._key = jax.random.key(seed)
        self._decide = jax.jit(functools.partial(_decide, self._network), static_argnames="deterministic")

    def predict(
        self,
        observation: Shaped[np.ndarray, "..."],
        state: State | None = None,
        episode_start: Bool[np.ndarray, "B"] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32[np.ndarray, "*B 2"], State | None]:
        """Wheel speeds as shares of the top speed, in [0, 1], and the state for the next call.

        Args:
            observation: of one environment or of B, as the environment gives it.
            state: what the call before returned; None where a drive begins. Policies without memory have none.
            episode_start: where an episode begins, and the state is to be forgotten; nowhere if it is left out.
            deterministic: the mean of the action's distribution, as evaluations drive; else an action drawn from it.

        Raises:
            ConfigError: for an observation that the policy was not trained with.
        """
        seen = np.asarray(observation)
        is_one = seen.ndim == len(self._network.observation_shape)
        batch = seen[None] if is_one else seen
        self._require_known(batch, seen)
        starts = np.zeros(len(batch)) if episode_start is None else np.asarray(episode_start)
        carry = self._network.initial_carry((len(batch),)) if state is None else state
        key = self._key
        if not deterministic:
            self._key, key = jax.random.split(key)
        told = self._decide(self._params, carry, batch, starts.astype(np.float32), key, deterministic=deterministic)
        actions, after = jax.device_get(told)
        return (actions[0] if is_one else actions), after or None

    def _require_known(self, batch: Shaped[np.ndarray, "B ..."], seen: Shaped[np.ndarray, "..."]) -> None:
        shape, dtype = self._network.observation_shape, np.dtype(self._network.observation_dtype)
        env = self.config.env
        made = f"obs={env.obs!r}" + (f", scale={env.camera.scale:g}" if self._network.has_convolutions else "")
        fits = batch.shape[1:] == shape and len(batch) > 0 and batch.dtype == dtype
        should = f"{dtype} of shape {shape}, or (B, {', '.join(map(str, shape))}), as make_env({made}) gives it"
        require(fits, "observation", f"{seen.dtype} of shape {seen.shape}", should)


def _decide(
    network: Network,
    params: Params,
    carry: Carry,
    observation: Shaped[Array, "B ..."],
    is_first: Float32[Array, "B"],
    key: PRNGKeyArray,
    deterministic: bool,
) -> tuple[Float32[Array, "B 2"], Any]:
    carry, output = network.step(params, carry, observation, is_first)
    action = output.mean if deterministic else DiagonalGaussian(output.mean, output.log_std).sample(key=key)
    return jnp.clip(action, 0.0, 1.0), carry

"""What is exported: one decision of one rover, as a function of observation, memory and whether a drive begins.

This file owns the function and the names, shapes and dtypes of its arrays, not any format.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, Shaped

from segvisrl_jax.agent.memory import Carry
from segvisrl_jax.agent.networks import Network, Params

CARRY_NAMES = ("cell", "hidden")  # in the order of ``agent.memory.Carry``
IS_FIRST_SHAPE = (1,)
ACTION_SHAPE = (1, 2)
HostCarry = tuple[Float32[np.ndarray, "1 S"], ...]
RunStep = Callable[
    [Shaped[np.ndarray, "1 ..."], HostCarry, Float32[np.ndarray, "1"]], tuple[Float32[np.ndarray, "1 2"], HostCarry]
]
"""``(observation, carry, is_first) -> (action, carry)`` on NumPy arrays: what opening an exported file gives."""


@dataclasses.dataclass(frozen=True)
class PolicyStep:
    """A network and its parameters, driving by the mean of its distribution (deterministic)."""

    network: Network
    params: Params

    def __call__(
        self, observation: Shaped[Array, "1 ..."], carry: Carry, is_first: Float32[Array, "1"]
    ) -> tuple[Float32[Array, "1 2"], Carry]:
        """(action, carry): wheel speeds as shares of the top speed, clipped to [0, 1] as the environment does.

        Args:
            observation: uint8 image (1, H, W, 3), or float32 vector (1, D).
            carry: the LSTM's (cell, hidden), each (1, lstm_size); ``()`` without memory.
            is_first: 1 where a drive begins: the carry is then taken as zeros.
        """
        carry, output = self.network.step(self.params, carry, observation, is_first)
        return jnp.clip(output.mean, 0.0, 1.0), carry

    @property
    def observation(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of an observation."""
        return jax.ShapeDtypeStruct((1, *self.network.observation_shape), self.network.observation_dtype)

    @property
    def carry(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        """Shape and dtype of each part of the carry, in the order of ``CARRY_NAMES``; empty without memory."""
        return jax.eval_shape(lambda: self.network.initial_carry((1,)))

    @property
    def is_first(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of ``is_first``."""
        return jax.ShapeDtypeStruct(IS_FIRST_SHAPE, jnp.float32)

    def start_carry(self) -> HostCarry:
        """The carry at the start of a drive: zeros."""
        return tuple(np.zeros(part.shape, part.dtype) for part in self.carry)

    def on_host(self) -> RunStep:
        """The step itself, on NumPy arrays, in full float32 precision: what a file is compared with."""
        return run_on_host(jax.jit(exact(self)))


def exact(step: Callable[..., Any]) -> Callable[..., Any]:
    """The same function with products in full float32 precision, on accelerators too."""

    def traced(observation, carry, is_first):
        with jax.default_matmul_precision("highest"):
            return step(observation, carry, is_first)

    return traced


def run_on_host(step: Callable[..., Any]) -> RunStep:
    """A step of JAX arrays as one of NumPy arrays."""
    return lambda observation, carry, is_first: jax.device_get(step(observation, carry, is_first))

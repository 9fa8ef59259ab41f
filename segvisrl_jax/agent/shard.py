"""Which part of all environments a program sees, where several devices, or cores of one, share them.

Programs are written once: with ``WHOLE`` on one device, with a ``Shard`` inside ``jax.shard_map`` or on a core. Random
numbers are drawn for all environments and cut: a run is the same on any number of them, up to the order of sums.
"""

from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32, Int32, Shaped

TreeT = TypeVar("TreeT")


@dataclass(frozen=True)
class Shard:
    """One of ``count`` equal parts: along an axis of the devices' mesh, or that with a number. Hashable without one."""

    axis: str | None = None
    count: int = 1
    number: Int32[Array, ""] | int = 0

    def of(self, whole: Shaped[Array, "N ..."]) -> Shaped[Array, "n ..."]:
        """The rows that belong to this part; n = N / count."""
        if self.count == 1:
            return whole
        size = whole.shape[0] // self.count
        number = self.number if self.axis is None else jax.lax.axis_index(self.axis)
        return jax.lax.dynamic_slice_in_dim(whole, number * size, size)

    def mean(self, tree: TreeT) -> TreeT:
        """The mean over all parts, of every leaf."""
        return tree if self.axis is None else jax.lax.pmean(tree, self.axis)

    def moments(self, values: Float32[Array, "..."]) -> tuple[Float32[Array, ""], Float32[Array, ""]]:
        """Mean and variance of the values in all parts."""
        mean = self.mean(jnp.mean(values))
        return mean, self.mean(jnp.mean((values - mean) ** 2))


WHOLE = Shard()

"""The action distribution: a diagonal Gaussian over the action before the environment clips it.

What lies outside [0, 1] is clipped by the environment, never in the log-probability.
"""

import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, PRNGKeyArray, UInt32

from segvisrl_jax.agent.shard import WHOLE, Shard

LOG_TWO_PI = math.log(2 * math.pi)


@struct.dataclass
class DiagonalGaussian:
    """Independent normal distributions, one for each component of the action."""

    mean: Float32[Array, "*B A"]
    log_std: Float32[Array, " A"]  # the same in every state

    def sample(self, *, key: PRNGKeyArray | UInt32[Array, "2"], shard: Shard = WHOLE) -> Float32[Array, "*B A"]:
        """One action for each batch element, of those that are a ``shard`` of all."""
        rows, *rest = self.mean.shape
        noise = shard.of(jax.random.normal(key, (shard.count * rows, *rest), self.mean.dtype))
        return self.mean + self._spread_over_batch(jnp.exp(self.log_std)) * noise

    def log_prob(self, action: Float32[Array, "*B A"]) -> Float32[Array, "*B"]:
        """Log-density of an action, summed over its components."""
        log_std = self._spread_over_batch(self.log_std)
        standardized = (action - self.mean) * jnp.exp(-log_std)
        return jnp.sum(-0.5 * (standardized**2 + LOG_TWO_PI) - log_std, axis=-1)

    def entropy(self) -> Float32[Array, "*B"]:
        """Differential entropy, summed over the components; the same for every batch element."""
        entropy = jnp.sum(self.log_std + 0.5 * (1.0 + LOG_TWO_PI))
        return jnp.broadcast_to(entropy, self.mean.shape[:-1])

    def _spread_over_batch(self, row: Float32[Array, " A"]) -> Float32[Array, "*B A"]:
        return jnp.broadcast_to(row, self.mean.shape)

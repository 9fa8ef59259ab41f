"""Generalised advantage estimation (Schulman et al., 2016): terminations and time limits apart."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32

Rows = tuple[Float32[Array, " B"], Float32[Array, " B"]]


def generalized_advantages(
    rewards: Float32[Array, "T B"],
    values: Float32[Array, "T B"],
    bootstrap_value: Float32[Array, " B"],
    terminated: Float32[Array, "T B"],
    truncated: Float32[Array, "T B"],
    truncation_values: Float32[Array, "T B"],
    discount: float,
    gae_lambda: float,
) -> tuple[Float32[Array, "T B"], Float32[Array, "T B"]]:
    """Advantages and value targets of a rollout.

    The value after a step is that of the next observation; 0 where the step terminated; and
    ``truncation_values`` where it was only truncated. No advantage flows back over either end.

    Args:
        rewards: rewards of the steps.
        values: values of the observations that the steps started from.
        bootstrap_value: value of the observation after the last step.
        terminated: 1 where the task ended the episode at this step. It wins over ``truncated``.
        truncated: 1 where the time limit alone ended it.
        truncation_values: where truncated, the value of the episode's final observation, before
            the reset; zeros where a time limit counts as an end. Ignored elsewhere.
        discount: per step.
        gae_lambda: 0 gives one-step, 1 gives Monte Carlo advantages.

    Returns:
        (advantages, value targets); the targets are advantages + values.
    """
    next_values = jnp.concatenate([values[1:], bootstrap_value[None]])
    next_values = jnp.where(truncated > 0, truncation_values, next_values)
    next_values = jnp.where(terminated > 0, 0.0, next_values)
    deltas = rewards + discount * next_values - values
    ended = (terminated > 0) | (truncated > 0)
    decays = jnp.where(ended, 0.0, jnp.full_like(rewards, discount * gae_lambda))
    start = jnp.zeros_like(bootstrap_value)
    _, advantages = jax.lax.scan(_add_step, start, (deltas, decays), reverse=True)
    return advantages, advantages + values


def _add_step(later_advantage: Float32[Array, " B"], step: Rows) -> tuple[Float32[Array, " B"], Float32[Array, " B"]]:
    delta, decay = step
    advantage = delta + decay * later_advantage
    return advantage, advantage

"""What PPO minimises (Schulman et al., 2017): from a trajectory to a batch, from a batch to a loss.

How the loss is minimised is in ppo.py.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, Shaped

from segvisrl_jax.agent.distributions import DiagonalGaussian
from segvisrl_jax.agent.gae import generalized_advantages
from segvisrl_jax.agent.networks import Carry, Network, Params
from segvisrl_jax.agent.shard import WHOLE, Shard
from segvisrl_jax.config import PPOConfig

TINY = 1e-8  # keeps a division by a standard deviation or a variance finite


Draw = Callable[[Any], Shaped[Array, "T B ..."]]
"""Makes observations (T, B, ...) from whatever a trajectory holds in their place."""


@struct.dataclass
class Trajectory:
    """T decisions of B environments, and the carry before the first one."""

    observation: Any  # Shaped[Array, "T B ..."], or a pytree (T, B, ...) that the learner's ``draw`` makes one from
    action: Float32[Array, "T B 2"]  # as sampled, before the environment clips it
    log_prob: Float32[Array, "T B"]  # of that action, when it was taken
    value: Float32[Array, "T B"]
    reward: Float32[Array, "T B"]  # already scaled
    terminated: Float32[Array, "T B"]  # 1 where the task ended the episode at this step
    truncated: Float32[Array, "T B"]  # 1 where only the time limit ended it
    truncation_value: Float32[Array, "T B"]  # value of the final observation where truncated
    reset: Float32[Array, "T B"]  # 1 where an episode begins with this observation
    carry: Carry  # (B, ...)


@struct.dataclass
class Batch:
    """What the loss reads of a trajectory."""

    observation: Any  # as in the trajectory
    action: Float32[Array, "T B 2"]
    log_prob: Float32[Array, "T B"]
    advantage: Float32[Array, "T B"]
    value_target: Float32[Array, "T B"]
    reset: Float32[Array, "T B"]
    carry: Carry


@struct.dataclass
class LossTerms:
    """Parts of the loss and what is watched beside it, as means over a minibatch."""

    loss: Float32[Array, ""]
    policy_loss: Float32[Array, ""]
    value_loss: Float32[Array, ""]
    entropy: Float32[Array, ""]
    approx_kl: Float32[Array, ""]
    clip_fraction: Float32[Array, ""]
    action_std: Float32[Array, ""]


def clipped_surrogate_loss(
    log_ratio: Float32[Array, "*B"], advantage: Float32[Array, "*B"], clip_epsilon: float
) -> Float32[Array, ""]:
    """PPO's policy loss (Schulman et al., 2017, equation 7) from log(new density / old density)."""
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip_epsilon, 1.0 + clip_epsilon)
    return -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))


def ppo_loss(
    params: Params, batch: Batch, network: Network, config: PPOConfig, draw: Draw | None = None
) -> tuple[Float32[Array, ""], LossTerms]:
    """The loss of a batch, and its parts.

    The approximate KL divergence from the old to the new policy is mean(ratio - 1 - log ratio).
    """
    observation = batch.observation if draw is None else draw(batch.observation)
    return loss_of_maps(params, network.maps(params, observation), batch, network, config)


def loss_of_maps(
    params: Params, maps: Float32[Array, "T B M"], batch: Batch, network: Network, config: PPOConfig
) -> tuple[Float32[Array, ""], LossTerms]:
    """``ppo_loss`` from what ``network.maps`` made of the observations."""
    _, output = network.unroll_maps(params, batch.carry, maps, batch.reset)
    distribution = DiagonalGaussian(output.mean, output.log_std)
    log_ratio = distribution.log_prob(batch.action) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    policy_loss = clipped_surrogate_loss(log_ratio, batch.advantage, config.clip_epsilon)
    value_loss = 0.5 * jnp.mean((output.value - batch.value_target) ** 2)
    entropy = jnp.mean(distribution.entropy())
    loss = policy_loss + config.value_cost * value_loss - config.entropy_cost * entropy
    clipped = jnp.abs(ratio - 1.0) > config.clip_epsilon
    return loss, LossTerms(
        loss=loss,
        policy_loss=policy_loss,
        value_loss=value_loss,
        entropy=entropy,
        approx_kl=jnp.mean(ratio - 1.0 - log_ratio),
        clip_fraction=jnp.mean(clipped.astype(jnp.float32)),
        action_std=jnp.mean(jnp.exp(output.log_std)),
    )


def make_batch(
    trajectory: Trajectory, last_value: Float32[Array, " B"], config: PPOConfig, shard: Shard = WHOLE
) -> tuple[Batch, Float32[Array, ""]]:
    """A trajectory with its advantages and value targets, and the targets' explained variance.

    Args:
        trajectory: the rollout.
        last_value: value of the observation after its last step.
        config: discount, GAE and whether a time limit counts as an end.
        shard: which part of the environments these are.
    """
    bootstrapped = trajectory.truncation_value if config.bootstrap_on_timeout else 0.0
    advantage, value_target = generalized_advantages(
        trajectory.reward,
        trajectory.value,
        last_value,
        trajectory.terminated,
        trajectory.truncated,
        jnp.broadcast_to(bootstrapped, trajectory.reward.shape),
        config.discount,
        config.gae_lambda,
    )
    mean, variance = shard.moments(advantage)
    unexplained = variance / (shard.moments(value_target)[1] + TINY)
    if config.normalize_advantage:
        advantage = (advantage - mean) / (jnp.sqrt(variance) + TINY)
    batch = Batch(
        observation=trajectory.observation,
        action=trajectory.action,
        log_prob=trajectory.log_prob,
        advantage=advantage,
        value_target=value_target,
        reset=trajectory.reset,
        carry=trajectory.carry,
    )
    return batch, 1.0 - unexplained


def take_environments(batch: Batch, envs: Int32[Array, " N"]) -> Batch:
    """The part of a batch that belongs to some environments, whole in time."""
    carry = jax.tree.map(lambda part: part[envs], batch.carry)
    rows = jax.tree.map(lambda part: jnp.take(part, envs, axis=1), dataclasses.replace(batch, carry=()))
    return dataclasses.replace(rows, carry=carry)

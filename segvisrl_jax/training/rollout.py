"""Acting: the current policy drives B environments for T decisions, and what happened is kept for learning."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, PRNGKeyArray

from segvisrl_jax.agent.distributions import DiagonalGaussian
from segvisrl_jax.agent.loss import Trajectory
from segvisrl_jax.agent.networks import Network
from segvisrl_jax.agent.shard import WHOLE, Shard
from segvisrl_jax.config import PPOConfig
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import BatchEnv, BatchState, BatchStep
from segvisrl_jax.types import RewardTerms


@struct.dataclass
class ActorState:
    """What acting carries from one rollout to the next."""

    env: BatchState
    carry: Any  # the network's memory, (B, ...)
    key: PRNGKeyArray


@struct.dataclass
class EpisodeLog:
    """What each decision said about its episode, (T, B): read where ``outcome`` is not RUNNING."""

    outcome: Int32[Array, "T B"]
    episode_return: Float32[Array, "T B"]
    num_decisions: Int32[Array, "T B"]
    path_length_m: Float32[Array, "T B"]
    terms: RewardTerms


def start_acting(key: PRNGKeyArray, num_envs: int, env: RoverEnv, network: Network) -> ActorState:
    """Fresh environments, empty memory."""
    env_key, act_key = jax.random.split(key)
    return ActorState(BatchEnv(env, num_envs).reset(env_key), network.initial_carry((num_envs,)), act_key)


def unroll(
    params: Any, actor: ActorState, env: BatchEnv, network: Network, config: PPOConfig, shard: Shard = WHOLE
) -> tuple[ActorState, Trajectory, Float32[Array, "B"], EpisodeLog]:
    """Drives ``config.unroll_length`` decisions of B environments, which are a ``shard`` of all.

    Returns:
        The actor afterwards; the trajectory (T, B) with the carry it began with; the value (B,) of where it ends;
        the episodes' log (T, B).
    """
    decide = functools.partial(_decide, env=env, network=network, config=config, shard=shard)
    after, (steps, log) = jax.lax.scan(lambda state, _: decide(params, state), actor, None, length=config.unroll_length)
    trajectory = Trajectory(carry=actor.carry, **steps)
    observation = env.observe(after.env)
    _, last = network.step(params, after.carry, observation, after.env.is_first)
    return after, trajectory, last.value, log


def _decide(
    params: Any, actor: ActorState, env: BatchEnv, network: Network, config: PPOConfig, shard: Shard
) -> tuple[ActorState, tuple[dict[str, Any], EpisodeLog]]:
    next_key, action_key = jax.random.split(actor.key)
    observation = env.observe(actor.env)
    carry, output = network.step(params, actor.carry, observation, actor.env.is_first)
    distribution = DiagonalGaussian(output.mean, output.log_std)
    action = distribution.sample(key=action_key, shard=shard)
    after, step = env.step(actor.env, action)
    kept = {
        "observation": actor.env.rover if config.redraw_observations else observation,
        "action": action,
        "log_prob": distribution.log_prob(action),
        "value": output.value,
        "reward": step.reward * config.reward_scale,
        "terminated": step.terminated,
        "truncated": step.truncated,
        "truncation_value": _truncation_value(params, carry, step, env, network, config),
        "reset": actor.env.is_first,
    }
    log = EpisodeLog(step.outcome, step.episode_return, step.num_decisions, step.rover.path_length_m, step.terms)
    return ActorState(after, carry, next_key), (kept, log)


def _truncation_value(
    params: Any, carry: Any, step: BatchStep, env: BatchEnv, network: Network, config: PPOConfig
) -> Float32[Array, "B"]:
    """Value of the state that the time limit cut off; looks at it only where there is one to see."""
    nothing = jnp.zeros(env.num_envs, jnp.float32)
    if not config.bootstrap_on_timeout:
        return nothing

    def look(_: None) -> Float32[Array, "B"]:
        observation = jax.vmap(env.env.observe)(step.rover)
        return network.step(params, carry, observation, nothing)[1].value

    return jax.lax.cond(jnp.any(step.truncated > 0), look, lambda _: nothing, None)

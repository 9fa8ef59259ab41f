"""The learner: networks, action distribution, advantages, PPO. It knows nothing of environments."""

from segvisrl_jax.agent.distributions import DiagonalGaussian
from segvisrl_jax.agent.gae import generalized_advantages
from segvisrl_jax.agent.loss import Trajectory
from segvisrl_jax.agent.networks import ActorCritic, Carry, Network, PolicyOutput, make_network
from segvisrl_jax.agent.ppo import Learner, LearnerState, make_learner

__all__ = [
    "ActorCritic",
    "Carry",
    "DiagonalGaussian",
    "Learner",
    "LearnerState",
    "Network",
    "PolicyOutput",
    "Trajectory",
    "generalized_advantages",
    "make_learner",
    "make_network",
]

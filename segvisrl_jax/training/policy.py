"""What drives: one interface for controllers and trained networks.

A policy is data (``params``) and two pure functions, so that an evaluation compiles once for all checkpoints.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32, PRNGKeyArray

from segvisrl_jax.agent.networks import Network, Params, make_network
from segvisrl_jax.config import EnvConfig, TrainConfig, require
from segvisrl_jax.env.pose import yaw_rad
from segvisrl_jax.env.rover_env import observation_shape
from segvisrl_jax.training.checkpoint import load_policy
from segvisrl_jax.types import Action, Observation, RoverState

Carry = Any
P_CRUISE = 0.8  # share of the top speed when the goal is straight ahead (paper, section IV: the P controller)


@dataclasses.dataclass(frozen=True)
class Policy:
    """Acts for a batch of B rovers.

    ``act(params, carry, rover, observation, is_first, key) -> (carry, action)``: ``rover`` is the true state, for
    controllers that may know it; ``observation`` is None where ``observes`` is False; ``is_first`` is 1 where an
    episode begins; ``key`` is for policies that draw.
    """

    name: str
    observes: bool
    initial_carry: Callable[[int], Carry]
    act: Callable[
        [Any, Carry, RoverState, Observation | None, Float32[Array, "B"], PRNGKeyArray],
        tuple[Carry, Action],
    ]


def p_controller() -> Policy:
    """The paper's proportional controller: it knows where the goal is, and no rocks.

    Wheel speeds are 0.8 minus and plus the bearing of the goal in radians, as shares of the top speed, clipped to
    [0, 1].
    """

    def act(params, carry, rover, observation, is_first, key):
        bearing = jax.vmap(goal_bearing_rad)(rover)
        return carry, jnp.clip(jnp.stack([P_CRUISE - bearing, P_CRUISE + bearing], axis=-1), 0.0, 1.0)

    return Policy("p", observes=False, initial_carry=lambda num_envs: (), act=act)


def random_controller() -> Policy:
    """Uniform wheel speeds in [0, 1], drawn anew for every decision."""

    def act(params, carry, rover, observation, is_first, key):
        return carry, jax.random.uniform(key, (*rover.outcome.shape, 2))

    return Policy("random", observes=False, initial_carry=lambda num_envs: (), act=act)


def planner(world: EnvConfig) -> Policy:
    """The privileged planner (``planner.planner``, which builds on this file: imported when asked for)."""
    from segvisrl_jax.training import planner

    return planner.planner(world)


CONTROLLERS: dict[str, Callable[[EnvConfig], Policy]] = {
    "p": lambda world: p_controller(),
    "random": lambda world: random_controller(),
    "planner": planner,
}
"""By the names that the command line takes, for the world in which they drive."""


def network_policy(network: Network, name: str) -> Policy:
    """A trained network, driving by the mean of its distribution (deterministic)."""

    def act(params, carry, rover, observation, is_first, key):
        carry, output = network.step(params, carry, observation, is_first)
        return carry, output.mean

    return Policy(name, observes=True, initial_carry=lambda num_envs: network.initial_carry((num_envs,)), act=act)


def load_network(folder: Path) -> tuple[TrainConfig, Network, Params]:
    """A policy's settings, its network, and its parameters, which fit.

    Args:
        folder: or the name of a shipped policy, as for ``checkpoint.load_policy``.

    Raises:
        ConfigError: where it is missing or damaged; the message names the file.
    """
    config, params, _ = load_policy(folder)
    network = make_network(config.arch, config.network, observation_shape(config.env))
    _require_parameters_that_fit(params, network, folder)
    return config, network, params


def _require_parameters_that_fit(params: Params, network: Network, folder: Path) -> None:
    """A policy's folder may have been put together by hand."""
    needed = jax.eval_shape(network.init, jax.random.key(0))
    ours, theirs = (
        {jax.tree_util.keystr(path): leaf.shape for path, leaf in _leaves(tree)} for tree in (params, needed)
    )
    for name in sorted(ours.keys() | theirs.keys()):
        should = f"of shape {theirs[name]}, as its settings have it" if name in theirs else "left out"
        require(ours.get(name) == theirs.get(name), f"{folder}: {name}", ours.get(name), should)


def _leaves(tree: Any) -> list[tuple[Any, Any]]:
    return jax.tree_util.tree_flatten_with_path(tree)[0]


def goal_bearing_rad(rover: RoverState) -> Float32[Array, ""]:
    """Angle of the goal off the rover's forward axis, to the left, in (-pi, pi]. Unbatched."""
    offset = rover.scene.goal_xy_m - rover.physics.qpos[:2]
    angle = jnp.arctan2(offset[1], offset[0]) - yaw_rad(rover.physics.qpos)
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))

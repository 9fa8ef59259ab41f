"""One point of ``segvisrl bench growth``, in a process of its own, whose memory is then that of this point alone.

``python -m segvisrl_jax.machine.growth_point`` reads a request as JSON and prints the answer as a line of JSON.
"""

import dataclasses
import functools
import json
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from segvisrl_jax.agent.loss import Trajectory
from segvisrl_jax.agent.networks import ACTION_SIZE, Network, make_network
from segvisrl_jax.agent.ppo import make_learner
from segvisrl_jax.config import PPOConfig, TrainConfig, from_dict, replace_fields
from segvisrl_jax.env.rover_env import RoverEnv, observation_shape
from segvisrl_jax.env.wrappers import BatchEnv
from segvisrl_jax.machine.finding import GIB
from segvisrl_jax.machine.limits import time_calls
from segvisrl_jax.machine.memory import keep_freed_memory, peak_bytes
from segvisrl_jax.machine.speed import STEADY_ACTION

ENOUGH_S = 5.0  # learning that takes so long is timed once: noise is far less


def measure(config: TrainConfig, repeats: int) -> dict[str, float]:
    """Milliseconds a decision of each part of a training on images, and the most memory that the process had.

    Physics, rendering and the network's decision are those of all environments at once. Learning is a gradient step
    on one minibatch, times the epochs; the whole batch is there, as it is in training, and holds zeros.
    """
    network = make_network(config.arch, config.network, observation_shape(config.env))
    parts = acting_parts_ms(config, network, repeats)
    return {
        "physics_ms": parts["physics"],
        "rendering_ms": parts["rendering"],
        "acting_ms": parts["network"],
        "learning_ms": 1e3 * _learning_s(network, config.ppo, repeats),
        "memory_gib": peak_bytes() / GIB,
    }


def acting_parts_ms(config: TrainConfig, network: Network, repeats: int) -> dict[str, float]:
    """Milliseconds a decision of physics, rendering and the network, each for all environments at once."""
    num_envs = config.ppo.num_envs
    batch = BatchEnv(RoverEnv(config.env), num_envs)
    state = jax.jit(batch.reset)(jax.random.key(0))
    action = jnp.full((num_envs, ACTION_SIZE), STEADY_ACTION)

    def of_a_decision(call: Callable[[], Any]) -> float:
        return 1e3 * time_calls(call, repeats, ENOUGH_S)[1] / num_envs

    return {
        "physics": of_a_decision(functools.partial(jax.jit(batch.step), state, action)),
        "rendering": of_a_decision(functools.partial(jax.jit(batch.observe), state)),
        "network": of_a_decision(_acting(network, num_envs)),
    }


def _acting(network: Network, num_envs: int) -> Callable[[], Any]:
    """The network's decision for all environments."""
    observation = jnp.zeros((num_envs, *network.observation_shape), network.observation_dtype)
    given = (network.init(jax.random.key(0)), network.initial_carry((num_envs,)), observation, jnp.zeros(num_envs))
    return functools.partial(jax.jit(network.step), *given)


def _learning_s(network: Network, config: PPOConfig, repeats: int) -> float:
    """Of all epochs, for one decision."""
    num_envs = config.num_envs // config.num_minibatches
    few = replace_fields(config, num_envs=num_envs, num_minibatches=1, num_epochs=1, kl_stop=0.0)
    learner = make_learner(network, few, total_updates=1)
    state = learner.init(jax.random.key(0))
    whole = _empty_trajectory(network, config)
    rows = jax.tree.map(lambda leaf: leaf[:, :num_envs], dataclasses.replace(whole, carry=()))
    part = dataclasses.replace(rows, carry=jax.tree.map(lambda leaf: leaf[:num_envs], whole.carry))
    update = functools.partial(learner.update, state, part, jnp.zeros(num_envs), jax.random.key(0))
    return config.num_epochs * time_calls(update, repeats, ENOUGH_S)[1] / few.decisions_per_update


def _empty_trajectory(network: Network, config: PPOConfig) -> Trajectory:
    sizes = (config.unroll_length, config.num_envs)
    numbers: dict[str, Any] = {field.name: jnp.zeros(sizes) for field in dataclasses.fields(Trajectory)}
    numbers["observation"] = jnp.zeros((*sizes, *network.observation_shape), network.observation_dtype)
    numbers["action"] = jnp.zeros((*sizes, ACTION_SIZE))
    return Trajectory(**(numbers | {"carry": network.initial_carry((config.num_envs,))}))


def main() -> None:
    """Answers one request."""
    keep_freed_memory()  # as the commands do
    asked = json.loads(sys.stdin.read())
    print(json.dumps(measure(from_dict(TrainConfig, asked["config"]), asked["repeats"])), flush=True)


if __name__ == "__main__":
    main()

"""Probe environments with a known answer, solved by the learner that ships.

Each isolates one ability, from the value of a constant reward to memory; if one fails, the one
before it says where to look.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from segvisrl_jax.agent.distributions import DiagonalGaussian
from segvisrl_jax.agent.loss import Trajectory
from segvisrl_jax.agent.networks import Network, make_network
from segvisrl_jax.agent.ppo import make_learner
from segvisrl_jax.config import NetworkConfig, PPOConfig

NETWORK = NetworkConfig(channels=(4,), blocks_per_stage=0, feature_size=16, lstm_size=16, mlp_sizes=(16,))
NUM_ENVS, UNROLL_LENGTH, DISCOUNT = 32, 12, 0.9
WHITE = 255


class Probe(NamedTuple):
    """Episodes of a fixed length; what is seen and paid depends on a cue and the time."""

    length: int  # decisions in an episode
    observe: Callable  # (cue in {0, 1}, time in the episode) -> observation
    reward: Callable  # (cue, time, action (2,)) -> reward


def sign(cue: jax.Array) -> jax.Array:
    """-1 for cue 0, 1 for cue 1."""
    return 2.0 * cue.astype(jnp.float32) - 1.0


class Situation(NamedTuple):
    """Where B environments stand between two rollouts."""

    cue: jax.Array
    time: jax.Array
    carry: tuple


def drive(network: Network, probe: Probe, params, situation: Situation, key):
    """One rollout: the situation after it, the trajectory, and the value that follows."""
    observe, reward = jax.vmap(probe.observe), jax.vmap(probe.reward)

    def step(situation: Situation, key):
        act_key, cue_key = jax.random.split(key)
        cue, time, carry = situation
        begins, observation = (time == 0).astype(jnp.float32), observe(cue, time)
        carry, output = network.step(params, carry, observation, begins)
        policy = DiagonalGaussian(output.mean, output.log_std)
        action = policy.sample(key=act_key)
        ends = time == probe.length - 1
        new_cue = jax.random.bernoulli(cue_key, shape=cue.shape).astype(jnp.int32)
        after = Situation(jnp.where(ends, new_cue, cue), jnp.where(ends, jnp.zeros_like(time), time + 1), carry)
        rows = (observation, action, policy.log_prob(action), output.value)
        return after, (*rows, reward(cue, time, action), ends.astype(jnp.float32), begins)

    after, rows = jax.lax.scan(step, situation, jax.random.split(key, UNROLL_LENGTH))
    observation, action, log_prob, value, rewards, ends, begins = rows
    begins_next = (after.time == 0).astype(jnp.float32)
    seen_next = observe(after.cue, after.time)
    _, last = network.step(params, after.carry, seen_next, begins_next)
    nothing = jnp.zeros_like(ends)
    trajectory = Trajectory(
        observation=observation,
        action=action,
        log_prob=log_prob,
        value=value,
        reward=rewards,
        terminated=ends,
        truncated=nothing,
        truncation_value=nothing,
        reset=begins,
        carry=situation.carry,
    )
    return after, trajectory, last.value


def train(arch: str, probe: Probe, num_updates: int, seed: int = 0, **settings: float):
    """The network and its parameters after some updates."""
    options = {"learning_rate": 0.01, "discount": DISCOUNT, "num_minibatches": 4, **settings}
    config = PPOConfig(num_envs=NUM_ENVS, unroll_length=UNROLL_LENGTH, **options)
    cue = jnp.arange(NUM_ENVS) % 2
    time = jnp.zeros_like(cue)
    network = make_network(arch, NETWORK, probe.observe(cue[0], time[0]).shape)
    learner = make_learner(network, config, num_updates)
    collect = jax.jit(partial(drive, network, probe))
    state = learner.init(jax.random.key(seed))
    situation = Situation(cue, time, network.initial_carry((NUM_ENVS,)))
    for key in jax.random.split(jax.random.key(seed + 1), num_updates):
        drive_key, update_key = jax.random.split(key)
        situation, trajectory, last_value = collect(state.params, situation, drive_key)
        state, _ = learner.update(state, trajectory, last_value, update_key)
    return network, state.params


def answers(network: Network, params, probe: Probe):
    """Mean action and value at each time of an episode, for cue 0 and cue 1: (time, cue, ...)."""
    cues, times = jnp.arange(2), jnp.arange(probe.length)
    per_cue = jax.vmap(probe.observe, in_axes=(0, None))
    observation = jax.vmap(per_cue, in_axes=(None, 0))(cues, times)
    reset = jnp.zeros((probe.length, 2)).at[0].set(1.0)
    _, output = jax.jit(network.unroll)(params, network.initial_carry((2,)), observation, reset)
    return np.asarray(output.mean), np.asarray(output.value)


def pixel(lit: jax.Array, column: jax.Array) -> jax.Array:
    """A 4 x 6 image, black but for one bright pixel where ``lit``."""
    black = jnp.zeros((4, 6, 3), jnp.uint8)
    return black.at[1, column].set(jnp.where(lit, WHITE, 0).astype(jnp.uint8))


def test_a_constant_reward_is_learnt() -> None:
    probe = Probe(1, lambda cue, time: jnp.ones(1), lambda cue, time, action: jnp.ones(()))
    _, value = answers(*train("mlp", probe, 30), probe)
    np.testing.assert_allclose(value, 1.0, atol=0.05)


def test_value_depends_on_the_observation() -> None:
    def observe(cue: jax.Array, time: jax.Array) -> jax.Array:
        return sign(cue)[None]

    probe = Probe(1, observe, lambda cue, time, action: sign(cue))
    _, value = answers(*train("mlp", probe, 30), probe)
    np.testing.assert_allclose(value, [[-1.0, 1.0]], atol=0.1)


def test_value_is_discounted_over_two_steps() -> None:
    def observe(cue: jax.Array, time: jax.Array) -> jax.Array:
        return time.astype(jnp.float32)[None]

    probe = Probe(2, observe, lambda cue, time, action: time.astype(jnp.float32))
    _, value = answers(*train("mlp", probe, 60), probe)
    np.testing.assert_allclose(value[:, 0], [DISCOUNT, 1.0], atol=0.05)


@pytest.mark.parametrize("arch", ["mlp", "cnn", "cnn_lstm"])
def test_the_action_that_pays_most_is_found(arch: str) -> None:
    """The best speeds are (0.2, 0.8) for one observation and the reverse for the other."""

    def observe(cue: jax.Array, time: jax.Array) -> jax.Array:
        if arch == "mlp":
            return sign(cue)[None]
        return pixel(lit=jnp.asarray(True), column=1 + 3 * cue)

    def reward(cue: jax.Array, time: jax.Array, action: jax.Array) -> jax.Array:
        best = jnp.where(cue == 0, jnp.asarray([0.2, 0.8]), jnp.asarray([0.8, 0.2]))
        return -jnp.sum((action - best) ** 2)

    probe = Probe(1, observe, reward)
    mean, _ = answers(*train(arch, probe, 60), probe)
    np.testing.assert_allclose(mean[0], [[0.2, 0.8], [0.8, 0.2]], atol=0.1)


RECALL = Probe(
    length=4,
    # The cue is shown at the first step only; then nothing, whatever it was.
    observe=lambda cue, time: pixel(lit=time == 0, column=1 + 3 * cue),
    # At the last step: +1 for a left wheel above half speed after cue 1, or below it after cue 0.
    reward=lambda cue, time, action: jnp.where(time < 3, 0.0, jnp.where((action[0] > 0.5) == (cue == 1), 1.0, -1.0)),
)


def recall_rate(arch: str) -> tuple[float, np.ndarray]:
    """The share of cues answered rightly by the mean action, and those actions."""
    mean, _ = answers(*train(arch, RECALL, 80), RECALL)
    answer = mean[-1, :, 0]
    return float(np.mean((answer > 0.5) == np.array([False, True]))), answer


def test_a_cue_is_recalled_with_memory() -> None:
    rate, answer = recall_rate("cnn_lstm")
    assert rate == 1.0
    assert answer[1] - answer[0] > 0.4  # not by a hair: about two deviations of the first policy


def test_a_cue_is_not_recalled_without_memory() -> None:
    """At the last step both cues look the same, so one answer serves both, and half are wrong."""
    rate, answer = recall_rate("cnn")
    np.testing.assert_allclose(answer[0], answer[1], rtol=1e-6)
    assert rate == 0.5

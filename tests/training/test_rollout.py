"""What acting stores is what learning recomputes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import segvisrl_jax
from segvisrl_jax.agent.distributions import DiagonalGaussian
from segvisrl_jax.agent.networks import make_network
from segvisrl_jax.agent.ppo import make_learner
from segvisrl_jax.config import NetworkConfig, PPOConfig
from segvisrl_jax.env.wrappers import BatchEnv
from segvisrl_jax.training.rollout import start_acting, unroll

NETWORK = NetworkConfig(channels=(4, 4), blocks_per_stage=1, feature_size=16, lstm_size=8)


@pytest.fixture(scope="module")
def parts():
    env = segvisrl_jax.make_env(scale=120, physics="native", max_decisions=5)
    return BatchEnv(env, 4), make_network("cnn_lstm", NETWORK, env.observation_shape)


def roll(parts, config, times=1):
    env, network = parts
    params = network.init(jax.random.key(1))
    act = jax.jit(functools.partial(unroll, env=env, network=network, config=config))
    actor = start_acting(jax.random.key(2), env.num_envs, env.env, network)
    for _ in range(times):
        actor, trajectory, last_value, log = act(params, actor)
    return params, actor, trajectory, last_value, log


def test_log_probabilities_and_values_are_those_that_learning_recomputes(parts):
    config = PPOConfig(num_envs=4, unroll_length=12, num_minibatches=1)
    params, _, trajectory, _, _ = roll(parts, config, times=2)  # the second begins with a carry in mid-episode
    assert float(jnp.abs(trajectory.carry[0]).max()) > 0
    assert float(trajectory.reset[1:].sum()) > 0
    _, output = parts[1].unroll(params, trajectory.carry, trajectory.observation, trajectory.reset)
    again = DiagonalGaussian(output.mean, output.log_std).log_prob(trajectory.action)
    np.testing.assert_allclose(again, trajectory.log_prob, atol=2e-4)
    np.testing.assert_allclose(output.value, trajectory.value, atol=2e-4)


def test_the_value_of_a_cut_off_state_is_looked_up_only_where_wanted(parts):
    plain = PPOConfig(num_envs=4, unroll_length=12, num_minibatches=1)
    _, _, without, _, _ = roll(parts, plain)
    assert not np.asarray(without.truncation_value).any()
    wanted = PPOConfig(num_envs=4, unroll_length=12, num_minibatches=1, bootstrap_on_timeout=True)
    _, _, with_value, _, _ = roll(parts, wanted)
    cut = np.asarray(with_value.truncated) > 0
    assert cut.any()
    assert np.all(np.asarray(with_value.truncation_value)[cut] != 0)


def test_rewards_are_scaled_and_episodes_logged(parts):
    config = PPOConfig(num_envs=4, unroll_length=12, num_minibatches=1, reward_scale=0.01)
    _, _, trajectory, _, log = roll(parts, config)
    terms = sum(np.asarray(getattr(log.terms, n)) for n in ("progress", "collision", "fall", "timeout"))
    np.testing.assert_allclose(trajectory.reward, 0.01 * terms, atol=1e-5)
    ended = np.asarray(trajectory.terminated) + np.asarray(trajectory.truncated) > 0
    assert np.array_equal(ended, np.asarray(log.outcome) != 0)
    assert np.array_equal(ended[:-1], np.asarray(trajectory.reset)[1:] > 0)


def test_drawing_again_gives_the_update_that_storing_gives(parts):
    """Scenes and poses in place of images: the same parameters after an update."""
    env, network = parts
    updated = []
    for again in (False, True):
        config = PPOConfig(num_envs=4, unroll_length=12, num_minibatches=2, num_epochs=2, redraw_observations=again)
        _, _, trajectory, last_value, _ = roll(parts, config)
        draw = jax.vmap(jax.vmap(env.env.observe)) if again else None
        learner = make_learner(network, config, total_updates=1, draw=draw)
        state = learner.init(jax.random.key(1))
        after, _ = learner.update(state, trajectory, last_value, jax.random.key(3))
        updated.append(after.params)
        assert hasattr(trajectory.observation, "scene") == again
    for stored, drawn in zip(*map(jax.tree.leaves, updated), strict=True):
        np.testing.assert_allclose(drawn, stored, atol=1e-6)

"""A trained policy decides through ``predict`` as it does through the network, one or many at a time."""

import numpy as np
import pytest

from segvisrl_jax import ConfigError, Predictor
from segvisrl_jax.env.vector import STATE_SIZE
from segvisrl_jax.export.step import PolicyStep
from segvisrl_jax.training.policy import load_network

IMAGE = (27, 48, 3)


def images(count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, *IMAGE), np.uint8)


def vectors(count):
    return np.random.default_rng(0).normal(size=(count, STATE_SIZE)).astype(np.float32)


@pytest.fixture(scope="module")
def policy():
    return Predictor("cnn_lstm")


def test_it_decides_as_the_network_does_and_forgets_where_an_episode_begins(policy):
    _, network, params = load_network("cnn_lstm")
    step = PolicyStep(network, params)
    decide, carry, state = step.on_host(), step.start_carry(), None
    for image, begins in zip(images(4), [1.0, 0.0, 1.0, 0.0], strict=True):
        wanted, carry = decide(image[None], carry, np.array([begins], np.float32))
        action, state = policy.predict(image, state, np.array([begins > 0]))
        assert (action.shape, action.dtype) == ((2,), np.float32)
        np.testing.assert_allclose(action, wanted[0], atol=1e-5)


def test_many_are_as_each_alone(policy):
    first, second = images(3), images(3, seed=1)
    _, states = policy.predict(first)
    together, _ = policy.predict(second, states, np.array([False, True, False]))
    for place in range(3):
        _, state = policy.predict(first[place])
        alone, _ = policy.predict(second[place], None if place == 1 else state)
        np.testing.assert_allclose(together[place], alone, atol=1e-5)
    assert not np.allclose(together[0], policy.predict(second[0])[0], atol=1e-3)  # it remembers


def test_drawn_actions_follow_from_the_seed_and_stay_in_range():
    seen = vectors(64)
    drawn = [Predictor("mlp", seed=seed).predict(seen, deterministic=False) for seed in (5, 5, 6)]
    (first, state), (again, _), (other, _) = drawn
    assert state is None  # no memory
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)
    assert first.min() >= 0.0
    assert first.max() <= 1.0
    mlp = Predictor("mlp", seed=5)
    assert np.any(mlp.predict(seen, deterministic=False)[0] != mlp.predict(seen, deterministic=False)[0])
    np.testing.assert_array_equal(mlp.predict(seen)[0], mlp.predict(seen)[0])


@pytest.mark.parametrize(
    ("seen", "says"),
    [
        (np.zeros((54, 96, 3), np.uint8), r"uint8 of shape \(54, 96, 3\)'"),
        (np.zeros((2, 54, 96, 3), np.uint8), r"uint8 of shape \(2, 54, 96, 3\)'"),
        (np.zeros(IMAGE, np.float32), r"float32 of shape \(27, 48, 3\)'"),
        (np.zeros((0, *IMAGE), np.uint8), r"uint8 of shape \(0, 27, 48, 3\)'"),
        (np.zeros(3, np.float32), r"float32 of shape \(3,\)'"),
    ],
)
def test_what_it_was_not_trained_with_is_refused(seen, says, policy):
    should = r"uint8 of shape \(27, 48, 3\), or \(B, 27, 48, 3\), as make_env\(obs='segmentation', scale=40\) gives it"
    with pytest.raises(ConfigError, match=f"observation = '{says}: should be {should}"):
        policy.predict(seen)


@pytest.mark.slow
def test_stable_baselines3_evaluates_it():
    pytest.importorskip("stable_baselines3", reason="needs the extra [sb3]: make sb3")
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecMonitor

    from segvisrl_jax.adapters.stable_baselines3 import LunarRoverVecEnv

    envs = VecMonitor(LunarRoverVecEnv(2, scale=40))
    returns, lengths = evaluate_policy(Predictor("cnn_lstm"), envs, n_eval_episodes=4, return_episode_rewards=True)
    assert np.mean(returns) > 500  # the goal's reward is behind it
    assert max(lengths) < 100

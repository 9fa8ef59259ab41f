"""Stable-Baselines3's own checks, and its agents learn on the environment, alone and as a vector."""

import gymnasium
import numpy as np
import pytest

from segvisrl_jax import GYMNASIUM_ID, ConfigError

pytest.importorskip("stable_baselines3", reason="needs the extra [sb3]: make sb3")
pytest.importorskip("sb3_contrib", reason="needs the extra [sb3]: make sb3")

from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from segvisrl_jax.adapters.stable_baselines3 import LunarRoverVecEnv

IMAGE = {"scale": 30.0}  # 64 x 36: its CNN reads nothing smaller
FEW = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "device": "cpu"}


def test_it_has_nothing_to_say_against_it():
    check_env(gymnasium.make(GYMNASIUM_ID, scale=60.0).unwrapped)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "policy", "settings"),
    [(PPO, "CnnPolicy", IMAGE), (RecurrentPPO, "CnnLstmPolicy", IMAGE), (PPO, "MlpPolicy", {"obs": "state"})],
)
def test_its_agents_learn_alone_and_as_a_vector(agent, policy, settings):
    for env in (gymnasium.make(GYMNASIUM_ID, **settings), VecMonitor(LunarRoverVecEnv(2, **settings))):
        model = agent(policy, env, **FEW)
        before = [parameter.detach().numpy().copy() for parameter in model.policy.parameters()]
        model.learn(32)
        after = [parameter.detach().numpy() for parameter in model.policy.parameters()]
        assert model.num_timesteps == 32
        assert any(np.any(old != new) for old, new in zip(before, after, strict=True))
        assert all(np.all(np.isfinite(new)) for new in after)


def test_ends_are_told_as_it_wants_them():
    envs = LunarRoverVecEnv(3, obs="state", max_decisions=4)
    envs.seed(7)
    first = envs.reset()
    ahead = np.ones((3, 2), np.float32)
    for _ in range(4):
        seen, rewards, done, infos = envs.step(ahead)
    assert rewards.dtype == np.float32
    assert done.all()
    for place, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert (info["outcome"], info["is_success"]) == ("timeout", False)
        assert np.any(info["terminal_observation"] != seen[place])
    envs.seed(7)
    np.testing.assert_array_equal(first, envs.reset())


def test_options_are_refused_as_there_are_none():
    with pytest.raises(ConfigError, match=r"options = \{'scene': 3\}: should be empty"):
        LunarRoverVecEnv(2, obs="state").set_options({"scene": 3})


@pytest.mark.slow
def test_its_evaluation_drives_whole_episodes():
    envs = VecMonitor(LunarRoverVecEnv(4, obs="state", max_decisions=5))
    returns, lengths = evaluate_policy(
        PPO("MlpPolicy", envs, **FEW), envs, n_eval_episodes=8, return_episode_rewards=True
    )
    assert lengths == [5] * 8
    assert np.all(np.isfinite(returns))

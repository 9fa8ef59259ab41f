"""Gymnasium's own checks, its conventions for seeds, vectors and final observations, and the same task as ever."""

import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from segvisrl_jax import GYMNASIUM_ID, ConfigError, make_env
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream

AHEAD = np.ones(2, np.float32)


def made(**settings) -> gymnasium.Env:
    return gymnasium.make(GYMNASIUM_ID, **settings)


@pytest.mark.parametrize("settings", [{"scale": 60.0}, {"obs": "rgb", "scale": 120.0}, {"obs": "state_and_rocks"}])
def test_gymnasium_has_nothing_to_say_against_it(settings):
    env = made(render_mode="rgb_array", **settings)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*infinity")  # vectors have no bounds, as in Gymnasium's MuJoCo tasks
        check_env(env.unwrapped)
    env.close()


def test_spaces_are_those_of_what_is_seen():
    image, vector = made(scale=60.0), made(obs="state")
    assert image.observation_space == gymnasium.spaces.Box(0, 255, (18, 32, 3), np.uint8)
    assert vector.observation_space.shape == (7,)
    assert image.action_space == gymnasium.spaces.Box(0.0, 1.0, (2,), np.float32)


def test_an_episode_is_that_of_the_environment_itself():
    ours, env = made(obs="state", max_decisions=5), make_env(obs="state", max_decisions=5)
    seen, _ = ours.reset(options={"scene": 7})
    state = jax.jit(env.reset)(jax.random.fold_in(scene_stream(0, TEST_STREAM), 7))
    np.testing.assert_array_equal(seen, state.obs)
    step = jax.jit(env.step)
    for number in range(5):
        seen, reward, terminated, truncated, info = ours.step(AHEAD)
        state = step(state, AHEAD)
        np.testing.assert_array_equal(seen, state.obs)
        assert reward == float(state.reward)
        assert (terminated, truncated) == (False, number == 4)
    assert (info["outcome"], info["is_success"]) == ("timeout", False)
    assert info["path_length_m"] > 0.5
    with pytest.raises(gymnasium.error.ResetNeeded):
        ours.unwrapped.step(AHEAD)


def test_success_is_told():
    env = made(obs="state", num_rocks=0)
    (goal_x, goal_y, *_), _ = env.reset(seed=1)
    done = False
    while not done:
        bearing = np.arctan2(goal_y, goal_x)
        (goal_x, goal_y, *_), _, terminated, truncated, info = env.step(np.clip([0.8 - bearing, 0.8 + bearing], 0, 1))
        done = terminated or truncated
    assert terminated
    assert info["is_success"] is True
    assert info["outcome"] == "success"


def test_a_seed_determines_all_scenes_that_follow():
    first, second = made(obs="state"), made(obs="state")
    starts = [first.reset(seed=3)[0], first.reset()[0]]
    np.testing.assert_array_equal(starts, [second.reset(seed=3)[0], second.reset()[0]])
    assert np.any(starts[0] != starts[1])
    assert np.any(starts[0] != first.reset(seed=4)[0])


def test_rendering_shows_the_trail():
    env = made(scale=60.0, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    env.step(AHEAD)
    after = env.render()
    assert before.dtype == np.uint8
    assert before.shape == after.shape
    assert np.any(before != after)
    assert made(obs="state").unwrapped.render() is None


def vector(num_envs: int, **settings) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(GYMNASIUM_ID, num_envs=num_envs, **settings)


def test_many_rovers_in_one_program_reset_themselves():
    envs = vector(3, obs="state", max_decisions=4)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    starts, infos = envs.reset(seed=5)
    assert starts in envs.observation_space
    assert infos["outcome"].tolist() == ["running"] * 3
    actions = np.tile(AHEAD, (3, 1))
    for _ in range(3):
        seen, reward, terminated, truncated, infos = envs.step(actions)
        assert "final_obs" not in infos
        assert not truncated.any()
    last = seen
    seen, reward, terminated, truncated, infos = envs.step(actions)
    assert seen in envs.observation_space
    assert reward.shape == (3,)
    assert truncated.all()
    assert not terminated.any()
    assert infos["_final_obs"].all()
    assert infos["final_info"]["outcome"].tolist() == ["timeout"] * 3
    assert infos["outcome"].tolist() == ["running"] * 3
    final = np.stack(infos["final_obs"])
    assert np.all(np.abs(final[:, 0] - last[:, 0]) < 0.2 / 16 + 1e-3)  # a second farther, of 16 m
    assert np.all(np.abs(seen[:, 0] - starts[:, 0]) > 1e-6)  # other goals than the first episodes'


def test_only_those_that_ended_have_final_observations():
    envs = vector(8, obs="state", num_rocks=32)
    envs.reset(seed=0)
    while True:
        _, _, terminated, truncated, infos = envs.step(np.tile(AHEAD, (8, 1)))
        done = terminated | truncated
        if 0 < done.sum() < 8:
            break
    np.testing.assert_array_equal(infos["_final_obs"], done)
    np.testing.assert_array_equal([seen is not None for seen in infos["final_obs"]], done)
    assert set(infos["final_info"]["outcome"][done]) <= {"collision", "fall", "timeout", "success"}


def test_vectors_are_seeded_and_drawn():
    first, second = (vector(2, scale=60.0, render_mode="rgb_array") for _ in range(2))
    starts = first.reset(seed=2)[0]
    np.testing.assert_array_equal(starts, second.reset(seed=2)[0])
    assert np.any(starts[0] != starts[1])
    assert [frame.ndim for frame in first.render()] == [3, 3]


def test_gymnasiums_own_wrappers_work(tmp_path):
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(vector(2, obs="state", max_decisions=3))
    envs.reset(seed=0)
    for _ in range(3):
        *_, infos = envs.step(np.tile(AHEAD, (2, 1)))
    assert infos["episode"]["l"].tolist() == [3, 3]


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: made(colour="red"), "colour"),
        (lambda: made(render_mode="ascii", disable_env_checker=True).reset(), "render_mode = 'ascii'"),
        (lambda: made(obs="state").reset(options={"map": 1}), r"options = \['map'\]: should be among 'scene'"),
        (lambda: made(obs="state").reset(options={"scene": -1}), r"options\['scene'\] = -1"),
        (lambda: vector(2, obs="state").reset(options={"scene": 1}), "options"),
        (lambda: vector(0, obs="state"), "num_envs = 0"),
    ],
)
def test_mistakes_are_said(call, says):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ConfigError, match=says):
            call()

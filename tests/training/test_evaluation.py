"""Held-out scenes are the same whoever drives and however many at a time; shares and paths add up."""

import jax
import numpy as np
import pytest

import segvisrl_jax
from segvisrl_jax.env.wrappers import TEST_STREAM, TRAINING_STREAM, VALIDATION_STREAM, scene_stream
from segvisrl_jax.training.evaluation import Evaluator, Finished, summarize
from segvisrl_jax.training.policy import p_controller, random_controller
from segvisrl_jax.types import Outcome

EPISODES = 24


@pytest.fixture(scope="module")
def env():
    return segvisrl_jax.make_env(obs="state", physics="native")


@pytest.fixture(scope="module")
def p_result(env) -> Finished:
    return Evaluator(env, p_controller(), 8).run((), scene_stream(0, TEST_STREAM), EPISODES)


def test_scenes_and_results_do_not_depend_on_how_many_are_driven_at_a_time(env, p_result):
    other = Evaluator(env, p_controller(), 5).run((), scene_stream(0, TEST_STREAM), EPISODES)
    jax.tree.map(np.testing.assert_array_equal, other, p_result)


def test_every_method_drives_the_same_scenes(env, p_result):
    other = Evaluator(env, random_controller(), 24).run((), scene_stream(0, TEST_STREAM), EPISODES)
    np.testing.assert_array_equal(other.goal_xy_m, p_result.goal_xy_m)
    np.testing.assert_array_equal(other.rock_xy_m, p_result.rock_xy_m)
    assert np.mean(other.outcome == Outcome.SUCCESS) < 0.2


def test_the_streams_are_disjoint(env, p_result):
    sample = jax.jit(jax.vmap(lambda key: env.initial_state(key).scene.goal_xy_m))
    seen = set(map(tuple, p_result.goal_xy_m.tolist()))
    for stream in (TRAINING_STREAM, VALIDATION_STREAM):
        keys = jax.vmap(lambda i, s=stream: jax.random.fold_in(scene_stream(0, s), i))(np.arange(64))
        assert not seen & set(map(tuple, np.asarray(sample(keys)).tolist()))


def test_the_p_controller_reaches_most_goals(p_result):
    assert np.mean(p_result.outcome == Outcome.SUCCESS) > 0.75
    succeeded = p_result.outcome == Outcome.SUCCESS
    start = np.array([-12.0, 0.0])
    straight = np.linalg.norm(p_result.goal_xy_m - start, axis=1) - 1.0
    assert np.all(p_result.path_length_m[succeeded] > straight[succeeded] - 0.05)
    assert np.all(p_result.min_clearance_m[succeeded] >= 0.5)


def test_summary_by_hand(env):
    finished = Finished(
        outcome=np.array([Outcome.SUCCESS, Outcome.SUCCESS, Outcome.COLLISION, Outcome.TIMEOUT]),
        num_decisions=np.array([60, 80, 30, 100]),
        path_length_m=np.array([9.0, 18.0, 4.0, 15.0]),
        min_clearance_m=np.array([2.0, 0.6, 0.49, 1.0]),
        episode_return=np.array([900.0, 900.0, 300.0, 100.0]),
        goal_xy_m=np.tile(np.array([-2.0, 0.0]), (4, 1)),  # 10 m ahead: the shortest path is 9 m
        rock_xy_m=np.tile(np.array([[0.0, 9.0]]), (4, 1, 1)),
    )
    summary = summarize(finished, env)
    shares = [summary[name] for name in ("success", "collision", "fall", "timeout", "unstable")]
    assert shares == [0.5, 0.25, 0.0, 0.25, 0.0]
    assert summary["spl"] == pytest.approx((1.0 + 0.5) / 4)
    assert summary["path_ratio"] == pytest.approx(1.5)
    assert summary["mean_time_s"] == 70.0
    assert summary["min_clearance_m"] == pytest.approx(0.49)
    low, high = summary["success_ci95"]
    assert low < 0.5 < high


@pytest.mark.slow
def test_the_p_controller_does_what_the_paper_says(env):
    """Paper: 93.3 % success, 6.7 % collision, no fall, no timeout (30 trials)."""
    finished = Evaluator(env, p_controller(), 256).run((), scene_stream(0, TEST_STREAM), 2000)
    summary = summarize(finished, env)
    assert 0.92 <= summary["success"] <= 0.97
    assert 0.03 <= summary["collision"] <= 0.08
    assert summary["fall"] + summary["timeout"] < 0.01

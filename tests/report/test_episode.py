"""Recorded episodes are those that evaluations drive, and keep what was seen."""

import jax
import numpy as np
import pytest

from segvisrl_jax.config import EnvConfig, replace_fields
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.report import episode as module
from segvisrl_jax.report.episode import drive_episode, drive_episodes
from segvisrl_jax.training.evaluation import Evaluator
from segvisrl_jax.training.policy import p_controller
from segvisrl_jax.types import Outcome

NUMBERS = [5, 0, 3, 8, 9]


@pytest.fixture(scope="module")
def recorded():
    """The P controller on some scenes with many rocks, in batches of which the last is not full."""
    env = RoverEnv(replace_fields(EnvConfig(obs="state"), num_rocks=32))
    stream, done = scene_stream(0, TEST_STREAM), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BATCH", 2)
        driven = drive_episodes(env, p_controller(), (), stream, NUMBERS, done.append)
    assert done == [2, 4, 5]
    return env, stream, driven


def test_episodes_are_those_of_the_evaluation(recorded):
    env, stream, driven = recorded
    finished = Evaluator(env, p_controller(), 4).run((), stream, 10)
    assert {Outcome.SUCCESS, Outcome.COLLISION} <= {one.outcome for one in driven}
    for number, one in zip(NUMBERS, driven, strict=True):
        assert one.outcome == finished.outcome[number]
        assert one.num_decisions == finished.num_decisions[number]
        assert one.states.path_length_m[-1] == pytest.approx(finished.path_length_m[number], abs=1e-4)
        assert one.min_clearance_m == pytest.approx(finished.min_clearance_m[number], abs=1e-4)
        np.testing.assert_array_equal(one.state(0).scene.goal_xy_m, finished.goal_xy_m[number])


def test_an_episode_begins_at_the_start_and_stops_at_its_end(recorded):
    env, _, driven = recorded
    for one in driven:
        np.testing.assert_array_equal(one.states.num_decisions, np.arange(one.num_decisions + 1))
        assert np.all(one.states.outcome[:-1] == Outcome.RUNNING)
        assert one.states.outcome[-1] == one.outcome != Outcome.RUNNING
        np.testing.assert_allclose(one.xy_m[0], env.config.scene.start_xy_m)
        assert one.observations is None


def test_one_episode_keeps_what_there_was_to_see():
    env = RoverEnv(replace_fields(EnvConfig(), scale=60.0, max_decisions=6))
    one = drive_episode(env, p_controller(), (), scene_stream(0, TEST_STREAM), 7)
    assert one.outcome == Outcome.TIMEOUT
    assert one.observations.shape == (7, *env.observation_shape)
    np.testing.assert_array_equal(one.observations[2], jax.jit(env.observe)(one.state(2)))
    assert np.any(one.observations[0] != one.observations[-1])

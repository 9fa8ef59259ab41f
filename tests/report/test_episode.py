"""Recorded episodes are those that evaluations drive, and keep what was seen."""

import jax
import numpy as np
import pytest

from segvisrl_jax.config import ConditionsConfig, EnvConfig, replace_fields
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.report import episode as module
from segvisrl_jax.report.episode import VIEW_HEIGHT_PX, VIEW_WIDTH_PX, camera_view, drive_episode, drive_episodes
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


def seen_from(size, conditions, **settings):
    """A start under these conditions, from a camera whose picture is so many times as large as the view's."""
    pixels = {"width_px": size * VIEW_WIDTH_PX, "height_px": size * VIEW_HEIGHT_PX, "scale": 1.0}
    env = RoverEnv(replace_fields(EnvConfig(), conditions=conditions, **pixels, **settings))
    return env, env.initial_state(jax.random.key(2))


def test_the_view_is_that_of_the_moved_camera_and_the_wrong_segmentation():
    moved = {"camera_height_offset_m": 0.1, "camera_pitch_offset_deg": 4.0}
    env, rover = seen_from(1, ConditionsConfig(**moved, border_px=5), num_rocks=16)
    view = camera_view(env, "segmentation")(rover)
    np.testing.assert_array_equal(view, env.observe(rover))
    large, its_rover = seen_from(2, ConditionsConfig(**moved, border_px=10), num_rocks=16)
    np.testing.assert_array_equal(view, camera_view(large, "segmentation")(its_rover))
    plain, its_rover = seen_from(1, ConditionsConfig(), num_rocks=16)
    assert np.mean(view != camera_view(plain, "segmentation")(its_rover)) > 0.01


def test_the_view_asks_nothing_of_conditions_that_it_does_not_show():
    """As many rocks as there are shapes: segmentation under random conditions would have none left for ghosts."""
    env, rover = seen_from(1, ConditionsConfig(randomize=True), obs="rgb", num_rocks=64)
    assert camera_view(env, "segmentation")(rover).shape == (VIEW_HEIGHT_PX, VIEW_WIDTH_PX, 3)
    assert camera_view(env, "rgb")(rover).shape == (VIEW_HEIGHT_PX, VIEW_WIDTH_PX, 3)

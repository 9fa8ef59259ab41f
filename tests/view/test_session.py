"""The viewer's session: the environment's own state answers to a person's hands."""

import jax
import numpy as np
import pytest

from segvisrl_jax.commands.eval import load_driver, with_overrides
from segvisrl_jax.env.pose import yaw_rad
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.report.episode import drive_episode
from segvisrl_jax.types import Outcome
from segvisrl_jax.view.session import Session

SCENE = 7
AHEAD = np.array([1.0, 1.0], np.float32)


@pytest.fixture(scope="module")
def driven():
    """(environment, policy, parameters) of a shipped policy that sees."""
    policy, params, config = load_driver(None, "cnn_lstm", None)
    return RoverEnv(with_overrides(config, 4, None, None)), policy, params


@pytest.fixture(scope="module")
def shared(driven) -> Session:
    return Session(*driven, SCENE)


@pytest.fixture
def session(shared) -> Session:
    shared.new_scene(SCENE)
    return shared


def place(session: Session) -> np.ndarray:
    return np.asarray(session.rover.physics.qpos[:2])


def beside(session: Session, x_m: float, y_m: float) -> tuple[float, float]:
    x, y = place(session)
    return float(x) + x_m, float(y) + y_m


@pytest.mark.slow
def test_the_policy_drives_as_in_the_demo(session, driven):
    env, policy, params = driven
    episode = drive_episode(env, policy, params, scene_stream(0, TEST_STREAM), SCENE)
    for step in range(1, 8):
        assert np.array_equal(session.observation, episode.observations[step - 1])
        session.decide(None)
        assert np.array_equal(session.command, session.proposal)
        expected = np.asarray(episode.state(step).physics.qpos)
        np.testing.assert_allclose(session.rover.physics.qpos, expected, atol=1e-4)
    assert session.reward_sum == pytest.approx(float(episode.states.episode_return[7]), abs=1e-3)
    assert session.time_s == 7 * env.dt


def test_manual_driving_moves_straight_and_turns(session):
    start, heading = place(session), float(yaw_rad(session.rover.physics.qpos))
    for _ in range(3):
        session.decide(AHEAD)
    moved = place(session) - start
    along = np.array([np.cos(heading), np.sin(heading)])
    assert 0.4 < moved @ along < 0.61  # 3 s at 0.2 m/s, from rest
    assert abs(np.cross([*along, 0], [*moved, 0])[2]) < 0.01
    assert session.proposal is not None  # the policy was asked all the same
    assert np.array_equal(session.command, AHEAD)
    assert session.wheel_speeds_rad_s == pytest.approx(np.full(4, 0.2 / 0.07), rel=0.1)
    session.decide(np.array([0.2, 1.0], np.float32))
    assert float(yaw_rad(session.rover.physics.qpos)) > heading + 0.05


def test_a_decision_hands_out_the_poses_on_its_way(session):
    before = np.asarray(session.rover.physics.qpos)
    poses = session.decide(AHEAD)
    assert poses.shape == (session.env.config.task.num_judgements, 11)
    assert np.array_equal(poses[-1], session.rover.physics.qpos)
    assert np.all(np.diff([before[0], *poses[:, 0]]) > 0)


def test_a_rock_dragged_onto_the_rover_is_a_collision(session):
    looked = session.observation
    session.decide(AHEAD)
    assert session.outcome == Outcome.RUNNING
    session.move_rock(2, beside(session, 0.55, 0.0))
    assert session.rock_distance_m == pytest.approx(0.55, abs=1e-3)
    assert not np.array_equal(session.observation, looked)  # the camera sees it at once
    poses = session.decide(AHEAD)
    assert session.outcome == Outcome.COLLISION
    assert len(poses) < session.env.config.task.num_judgements  # it ended on the way
    assert session.reward_sum < -10
    assert len(session.decide(AHEAD)) == 0  # nothing moves any more


def test_the_goal_dragged_to_the_rover_is_a_success(session):
    far = session.goal_distance_m
    session.move_goal(beside(session, 0.8, 0.3))
    assert session.goal_distance_m < 1 < far
    session.decide(None)
    assert session.outcome == Outcome.SUCCESS
    assert session.is_over


def test_what_is_moved_stays_on_the_map(session):
    session.move_goal((99.0, -3.0))
    assert np.array_equal(session.scene.goal_xy_m, [12.5, -3.0])


def test_reset_gives_the_scene_as_drawn_and_restart_as_it_is(session):
    first = jax.device_get(session.rover)
    session.move_rock(0, (1.0, 2.0))
    session.move_goal((3.0, 4.0))
    session.decide(AHEAD)
    session.restart()
    assert np.array_equal(session.scene.rock_xy_m[0], [1.0, 2.0])
    assert np.array_equal(session.scene.goal_xy_m, [3.0, 4.0])
    assert np.array_equal(session.rover.physics.qpos, first.physics.qpos)
    assert session.time_s == session.reward_sum == 0
    session.decide(None)
    session.reset()
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(session.rover), first)


def test_another_scene_is_another(session):
    first = np.asarray(session.scene.rock_xy_m)
    session.new_scene(SCENE + 1)
    assert session.number == SCENE + 1
    assert not np.array_equal(session.scene.rock_xy_m, first)


def test_memory_begins_anew_with_every_episode(session):
    session.decide(None)
    first = session.proposal
    for _ in range(3):
        session.decide(None)
    session.reset()
    session.decide(None)
    assert np.array_equal(session.proposal, first)

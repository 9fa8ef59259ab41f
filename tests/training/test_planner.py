"""The planner keeps its margin, plans where an episode begins and nowhere else, and reaches every goal among rocks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import segvisrl_jax
from segvisrl_jax.config import EnvConfig
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream, select
from segvisrl_jax.training.evaluation import Evaluator
from segvisrl_jax.training.planner import MARGINS_M, NUM_POINTS, plan_path, planner
from segvisrl_jax.training.policy import CONTROLLERS
from segvisrl_jax.types import Outcome

START = np.array([-12.0, 0.0])
GOAL = np.array([0.0, 0.0])
MIDDLE_ROCK = np.array([[-6.0, 0.0]])
WALL = np.stack([np.full(60, -6.0), np.linspace(-12.5, 12.5, 60)], axis=-1)  # 0.42 m apart: no way through
CONFIG = EnvConfig(obs="state")


def length_m(path):
    return np.linalg.norm(np.diff(path, axis=0), axis=1).sum()


def from_rocks_m(path, rocks):
    return np.linalg.norm(path[:, None] - rocks, axis=-1).min()


@pytest.fixture(scope="module")
def env():
    return segvisrl_jax.make_env(obs="state", physics="native", num_rocks=1)


def batch_among(env, rocks, goals=(GOAL,), yaws_rad=(0.0,)):
    """Rovers at the start, one for each goal and heading, among the same rocks."""
    scene = jax.jit(env.initial_state)(jax.random.key(0)).scene.replace(rock_xy_m=jnp.asarray(rocks, jnp.float32))
    cases = [(np.asarray(goal, np.float32), np.float32(yaw)) for goal in goals for yaw in yaws_rad]
    goal_xy, yaw = (jnp.stack(values) for values in zip(*cases, strict=True))
    scenes = jax.vmap(lambda goal, yaw: scene.replace(goal_xy_m=goal, start_yaw_rad=yaw))(goal_xy, yaw)
    return jax.jit(jax.vmap(env.state_on))(scenes)


def drive(env, rover):
    """The final state of a batch, each left as it is once it ended, and its clearance and path on the way."""
    policy = planner(env.config)

    def decide(state, step):
        rover, carry = state
        is_first = jnp.where(step == 0, jnp.ones(len(rover.outcome)), 0.0)
        carry, action = policy.act((), carry, rover, None, is_first, jax.random.key(0))
        driven, _ = jax.vmap(env.advance)(rover, action)
        return (select(rover.outcome == Outcome.RUNNING, driven, rover), carry), action

    carry = policy.initial_carry(len(rover.outcome))
    (rover, _), actions = jax.jit(lambda *state: jax.lax.scan(decide, state, jnp.arange(100)))(rover, carry)
    return rover, np.asarray(actions)


def test_the_path_around_a_rock_in_the_middle():
    path = plan_path(START, GOAL, MIDDLE_ROCK, CONFIG)
    assert path.shape == (NUM_POINTS, 2)
    assert path.dtype == np.float32
    np.testing.assert_allclose(path[0], START, atol=1e-6)
    kept = 0.5 + MARGINS_M[0]
    assert from_rocks_m(path, MIDDLE_ROCK) == pytest.approx(kept, abs=2e-3)
    # two tangents of a circle half way between start and goal, and the arc between them
    half = np.sqrt(6**2 - kept**2) + kept * np.arcsin(kept / 6)
    to_centre = 2 * half
    beyond = np.linalg.norm(path[-1] - GOAL)  # 0.2 m: the path ends 0.8 m before the centre and leads on for 1 m
    assert beyond == pytest.approx(0.2, abs=1e-3)
    assert length_m(path) == pytest.approx(to_centre + beyond, abs=2e-3)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.01)


def test_a_narrow_gap_is_passed_with_a_narrower_margin():
    gap = 1.12  # between the centres of the two rocks in the middle: 0.06 m of room on either side of 0.5 m
    rocks = WALL[np.abs(WALL[:, 1]) > 0.8]
    rocks = np.concatenate([rocks, [[-6.0, gap / 2], [-6.0, -gap / 2]]])
    path = plan_path(START, GOAL, rocks, CONFIG)
    assert length_m(path) < 12.5
    assert from_rocks_m(path, rocks) > 0.5 + MARGINS_M[1] - 2e-3


def test_without_a_path_it_is_the_straight_line():
    goal = np.array([0.0, 5.0])
    path = plan_path(START, goal, WALL, CONFIG)
    direction = (goal - START) / 13
    np.testing.assert_allclose(path, START + np.linspace(0, 14, NUM_POINTS)[:, None] * direction, atol=1e-5)


def test_goals_at_the_edge_are_reached(env):
    rover, _ = drive(env, batch_among(env, MIDDLE_ROCK, [[-3.0, 12.5], [-3.0, -12.49], [-12.0, 12.5]]))
    assert np.all(rover.outcome == Outcome.SUCCESS)


def test_it_drives_around_the_rock_from_any_heading(env):
    yaws_rad = np.array([0.0, 2.0, np.pi, -2.0])
    rover, actions = drive(env, batch_among(env, MIDDLE_ROCK, yaws_rad=yaws_rad))
    assert np.all(rover.outcome == Outcome.SUCCESS)
    assert np.all(np.abs(rover.min_clearance_m - (0.5 + MARGINS_M[0])) < 0.05)
    shortest = 2 * (np.sqrt(6**2 - 0.5**2) + 0.5 * np.arcsin(0.5 / 6)) - 1.0
    turning = 0.25 * np.abs(yaws_rad)  # on the sharpest circle, whose radius is 0.21 m
    assert np.all(rover.path_length_m > shortest - 0.01)
    assert np.all(rover.path_length_m < shortest + 0.15 + 2 * turning)
    assert np.all((actions >= 0) & (actions <= 1))
    np.testing.assert_allclose(actions.max(axis=-1), 1.0)


def test_without_rocks_and_with_a_wall(env):
    free = dataclasses.replace(env.config, scene=dataclasses.replace(env.config.scene, num_rocks=0))
    rover, _ = drive(segvisrl_jax.RoverEnv(free), batch_among(env, np.zeros((0, 2))))
    assert rover.outcome[0] == Outcome.SUCCESS
    rover, _ = drive(env, batch_among(env, WALL))
    assert rover.outcome[0] == Outcome.COLLISION
    ahead = 6 - np.sqrt(0.5**2 - np.abs(WALL[:, 1]).min() ** 2)  # straight on, until two rocks are 0.5 m away
    assert ahead - 0.01 < rover.path_length_m[0] < ahead + 0.04


def test_a_path_is_planned_where_an_episode_begins_and_kept_elsewhere(env):
    policy = planner(env.config)
    act = jax.jit(lambda carry, rover, is_first: policy.act((), carry, rover, None, is_first, jax.random.key(0)))
    goals = ([0.0, 0.0], [0.0, 4.0], [-2.0, -5.0])
    here = batch_among(env, MIDDLE_ROCK, goals)
    planned = np.stack([plan_path(START, np.array(goal), MIDDLE_ROCK, CONFIG) for goal in goals])
    nothing = policy.initial_carry(3)
    first, _ = act(nothing, here, jnp.array([1.0, 0.0, 1.0]))
    np.testing.assert_allclose(first, np.where(np.array([1, 0, 1])[:, None, None], planned, 0.0), atol=1e-4)
    kept, actions = act(first, here, jnp.zeros(3))
    np.testing.assert_array_equal(kept, first)
    second, _ = act(kept, here, jnp.array([0.0, 1.0, 0.0]))
    np.testing.assert_array_equal(second[::2], first[::2])
    np.testing.assert_allclose(second[1], planned[1], atol=1e-4)
    assert np.isfinite(np.asarray(actions)).all()
    alone, action = act(second[2:], jax.tree.map(lambda leaf: leaf[2:], here), jnp.zeros(1))
    np.testing.assert_array_equal(alone, second[2:])
    np.testing.assert_allclose(action, actions[2:], atol=1e-5)


def test_sixty_scenes_with_sixteen_rocks_all_succeed():
    """In 25 slots, so that episodes begin at different times."""
    env = segvisrl_jax.make_env(obs="state", physics="native", num_rocks=16)
    policy = CONTROLLERS["planner"](EnvConfig())
    assert policy.name == "planner"
    finished = Evaluator(env, policy, 25).run((), scene_stream(5, TEST_STREAM), 60)
    assert np.all(finished.outcome == Outcome.SUCCESS)
    assert finished.min_clearance_m.min() > 0.5 + MARGINS_M[0] - 0.05
    assert finished.min_clearance_m.min() < 0.7  # there are rocks in the way

"""Reward and outcome, by hand: every outcome, and those that coincide."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from segvisrl_jax.config import EnvConfig, SceneConfig, TaskConfig
from segvisrl_jax.env.task import Track, judge
from segvisrl_jax.training.loop import held_out_env
from segvisrl_jax.types import Outcome, Scene

TASK, RULES = TaskConfig(), SceneConfig()
FAR_ROCK = (0.0, 9.0)


def scene(goal=(5.0, 0.0), rocks=(FAR_ROCK,)) -> Scene:
    rocks = jnp.asarray(rocks, jnp.float32).reshape(-1, 2)
    return Scene(
        goal_xy_m=jnp.asarray(goal, jnp.float32),
        goal_yaw_rad=jnp.float32(0),
        rock_xy_m=rocks,
        rock_yaw_rad=jnp.zeros(len(rocks)),
        rock_shape=jnp.arange(len(rocks), dtype=jnp.int32),
        start_yaw_rad=jnp.float32(0),
        sun_direction=jnp.array([0.0, 0.0, 1.0]),
    )


def track(places, up_z=1.0, is_finite=True) -> Track:
    places = jnp.asarray(places, jnp.float32)
    n = len(places)
    up = jnp.broadcast_to(jnp.asarray(up_z, jnp.float32), (n,))
    return Track(places, up, jnp.broadcast_to(jnp.asarray(is_finite), (n,)))


def drive(places, *, start=(0.0, 0.0), num_decisions=1, **kwargs):
    world = scene(**{k: v for k, v in kwargs.items() if k in ("goal", "rocks")})
    state = {k: v for k, v in kwargs.items() if k in ("up_z", "is_finite")}
    return judge(jnp.asarray(start), track(places, **state), world, jnp.int32(num_decisions), TASK, RULES)


def ahead(x0, step=0.04, y=0.0):
    return [(x0 + step * (i + 1), y) for i in range(5)]


def total(verdict) -> float:
    return float(verdict.terms.total())


def test_progress_pays_100_per_metre_and_regress_costs_as_much():
    forward = drive(ahead(0.0))
    assert int(forward.outcome) == Outcome.RUNNING
    assert int(forward.last) == 4
    assert total(forward) == pytest.approx(100 * 0.2, abs=1e-3)
    back = drive(ahead(0.0, step=-0.04))
    assert total(back) == pytest.approx(-100 * 0.2, abs=1e-3)
    assert float(forward.path_length_m) == pytest.approx(0.2, abs=1e-6)


def test_success_ends_at_the_first_interval_within_a_metre():
    # the goal's circle begins at x = 4: 3.9, 3.96, 4.02 -> the third interval
    verdict = drive(ahead(3.84, step=0.06), start=(3.84, 0.0))
    assert int(verdict.outcome) == Outcome.SUCCESS
    assert int(verdict.last) == 2
    assert total(verdict) == pytest.approx(100 * 0.18, abs=1e-3)


def test_exactly_one_metre_is_not_yet_success():
    verdict = drive([(4.0, 0.0)] * 5, start=(4.0, 0.0))
    assert int(verdict.outcome) == Outcome.RUNNING


def test_collision_within_half_a_metre_of_a_rock():
    # the rock's circle begins at x = 1.5: 1.44, 1.48, 1.52
    verdict = drive(ahead(1.40), start=(1.40, 0.0), rocks=[(2.0, 0.0)])
    assert int(verdict.outcome) == Outcome.COLLISION
    assert int(verdict.last) == 2
    assert total(verdict) == pytest.approx(100 * 0.12 - 100, abs=1e-3)
    assert float(verdict.min_clearance_m) == pytest.approx(0.48, abs=1e-5)


def test_a_margin_moves_the_collision_outwards_in_training_only():
    places = jnp.array([(1.30, 0.0), (1.36, 0.0), (1.42, 0.0), (1.48, 0.0), (1.52, 0.0)])
    world, env = scene(rocks=[(2.0, 0.0)]), EnvConfig(task=TaskConfig(collision_margin_m=0.1))
    for task, last in ((env.task, 2), (held_out_env(env).task, 4)):  # within 0.6 m, within 0.5 m
        verdict = judge(jnp.zeros(2), track(places), world, jnp.int32(1), task, RULES)
        assert int(verdict.outcome) == Outcome.COLLISION
        assert int(verdict.last) == last


def test_fall_off_the_map():
    verdict = drive(ahead(12.44, step=0.04), start=(12.44, 0.0), goal=(5.0, 0.0))
    assert int(verdict.outcome) == Outcome.FALL
    assert int(verdict.last) == 1
    assert total(verdict) == pytest.approx(-100 * 0.08 - 100, abs=1e-2)


@pytest.mark.parametrize(("tilt_deg", "outcome"), [(59.0, Outcome.RUNNING), (61.0, Outcome.FALL)])
def test_fall_when_tipped_over(tilt_deg, outcome):
    assert int(drive(ahead(0.0), up_z=np.cos(np.radians(tilt_deg))).outcome) == outcome


def test_timeout_after_100_decisions():
    assert int(drive(ahead(0.0), num_decisions=99).outcome) == Outcome.RUNNING
    late = drive(ahead(0.0), num_decisions=100)
    assert int(late.outcome) == Outcome.TIMEOUT
    assert total(late) == pytest.approx(20 - 20, abs=1e-3)


def test_collision_beats_success_at_the_same_instant():
    verdict = drive([(4.2, 0.0)] * 5, start=(3.9, 0.0), rocks=[(4.0, 0.4)])
    assert int(verdict.outcome) == Outcome.COLLISION


def test_collision_beats_fall_at_the_same_instant():
    verdict = drive([(12.6, 0.0)] * 5, start=(12.4, 0.0), rocks=[(12.4, 0.4)])
    assert int(verdict.outcome) == Outcome.COLLISION


def test_fall_beats_success_at_the_same_instant():
    verdict = drive([(12.6, 0.0)] * 5, start=(12.4, 0.0), goal=(12.0, 0.0))
    assert int(verdict.outcome) == Outcome.FALL


def test_success_beats_timeout_in_the_last_decision():
    verdict = drive(ahead(3.84, step=0.06), start=(3.84, 0.0), num_decisions=100)
    assert int(verdict.outcome) == Outcome.SUCCESS
    assert float(verdict.terms.timeout) == 0.0


def test_the_earlier_of_two_outcomes_counts():
    places = [(3.9, 0.0), (4.1, 0.0), (4.3, 0.0), (4.5, 0.0), (4.6, 0.0)]
    verdict = drive(places, start=(3.8, 0.0), rocks=[(4.9, 0.0)])  # success at 4.1, collision from 4.5
    assert int(verdict.outcome) == Outcome.SUCCESS
    assert int(verdict.last) == 1


def test_diverged_physics_is_unstable_and_its_numbers_stay_out_of_the_reward():
    places = [(0.04, 0.0), (0.08, 0.0), (np.nan, np.nan), (np.nan, np.nan), (np.nan, np.nan)]
    verdict = drive(places, is_finite=[True, True, False, False, False])
    assert int(verdict.outcome) == Outcome.UNSTABLE
    assert total(verdict) == pytest.approx(8.0, abs=1e-3)
    assert np.isfinite(float(verdict.path_length_m))
    assert np.isfinite(float(verdict.min_clearance_m))


def test_no_rocks_no_collision():
    verdict = drive(ahead(0.0), rocks=())
    assert int(verdict.outcome) == Outcome.RUNNING
    assert float(verdict.min_clearance_m) == np.inf


@given(st.lists(st.tuples(st.floats(-12, 12), st.floats(-12, 12)), min_size=5, max_size=5))
def test_progress_telescopes(places):
    """Summed interval by interval or first minus last: the same, as long as nothing ends the decision."""
    verdict = drive(places, goal=(40.0, 0.0), rocks=[(500.0, 0.0)])
    goal = np.array([40.0, 0.0])
    expected = 100 * (40.0 - np.linalg.norm(goal - places[-1]))
    assert float(verdict.terms.progress) == pytest.approx(expected, abs=0.05)

"""Intervals, the paired test, and the path metrics."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from segvisrl_jax.config import ConfigError
from segvisrl_jax.training.statistics import mcnemar, mcnemar_p_value, path_ratio, spl, wilson_interval

COUNTS = st.integers(1, 3000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))
LENGTHS = st.lists(st.tuples(st.booleans(), st.floats(0.1, 50), st.floats(0.0, 99)), min_size=1)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(27, 30, 0.744, 0.965), (28, 30, 0.787, 0.982), (990, 1000, 0.982, 0.995), (0, 30, 0, 0.114)],
)
def test_wilson_interval_of_known_counts(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-4)


@given(COUNTS)
def test_wilson_interval_solves_its_equation_and_contains_the_rate(counts):
    successes, trials = counts
    low, high = wilson_interval(successes, trials)
    rate, z = successes / trials, 1.959963984540054
    assert 0 <= low <= rate + 1e-12
    assert rate - 1e-12 <= high <= 1
    for bound in (low, high):  # both ends are where the score statistic reaches z
        assert (rate - bound) ** 2 == pytest.approx(z**2 * bound * (1 - bound) / trials, abs=1e-9)


@given(COUNTS)
def test_wilson_interval_is_symmetric_and_grows_with_confidence(counts):
    successes, trials = counts
    low, high = wilson_interval(successes, trials)
    mirrored_low, mirrored_high = wilson_interval(trials - successes, trials)
    assert (1 - mirrored_high, 1 - mirrored_low) == pytest.approx((low, high), abs=1e-9)
    wide_low, wide_high = wilson_interval(successes, trials, confidence=0.99)
    assert wide_low <= low + 1e-12
    assert wide_high >= high - 1e-12


@pytest.mark.parametrize("arguments", [(0, 0), (-1, 3), (4, 3), (1, 3, 1.0), (1, 3, 0.0)])
def test_wilson_interval_refuses(arguments):
    with pytest.raises(ConfigError, match="should be"):
        wilson_interval(*arguments)


@pytest.mark.parametrize(
    ("only_first", "only_second", "expected"),
    [
        (0, 0, 1.0),
        (5, 5, 1.0),
        (0, 5, 2 / 2**5),
        (1, 5, 2 * (1 + 6) / 2**6),
        (10, 2, 2 * 79 / 2**12),
    ],
)
def test_mcnemar_by_hand(only_first, only_second, expected):
    assert mcnemar_p_value(only_first, only_second) == pytest.approx(expected)


def test_mcnemar_counts_the_scenes_that_one_solved_and_the_other_not():
    both, only_first, only_second, neither = [1, 1], [1, 0], [0, 1], [0, 0]
    scenes = [both] * 7 + [only_first] * 10 + [only_second] * 2 + [neither] * 4
    first, second = np.array(scenes, bool).T
    assert mcnemar(first, second) == (10, 2, pytest.approx(2 * (1 + 12 + 66) / 2**12))
    assert mcnemar(second, first) == (2, 10, pytest.approx(2 * (1 + 12 + 66) / 2**12))
    assert mcnemar(first, first) == (0, 0, 1.0)


def test_mcnemar_refuses_other_numbers_of_scenes():
    with pytest.raises(ConfigError, match="second = 2: should be as many scenes as first, 3"):
        mcnemar(np.ones(3, bool), np.ones(2, bool))


@given(st.integers(0, 300), st.integers(0, 300))
def test_mcnemar_is_symmetric_and_sharper_when_more_uneven(first, second):
    p = mcnemar_p_value(first, second)
    assert 0 <= p <= 1
    assert p == pytest.approx(mcnemar_p_value(second, first))
    smaller, larger = sorted((first, second))
    if smaller > 0:
        assert mcnemar_p_value(smaller - 1, larger + 1) <= p + 1e-12


def test_mcnemar_refuses_negative_counts():
    with pytest.raises(ConfigError, match="only_second"):
        mcnemar_p_value(1, -1)


def test_spl_and_path_ratio_by_hand():
    success = np.array([True, True, False, True])
    shortest = np.array([10.0, 8.0, 5.0, 4.0])
    driven = np.array([20.0, 8.0, 5.0, 3.9])  # the last: judged at instants, a hair below the shortest
    assert spl(success, shortest, driven) == pytest.approx((0.5 + 1 + 0 + 1) / 4)
    assert path_ratio(success, shortest, driven) == pytest.approx((2 + 1 + 0.975) / 3)


def test_degenerate_paths():
    success = np.array([True, True, False])
    shortest = np.array([0.0, np.inf, np.inf])
    driven = np.array([0.0, 3.0, 3.0])
    assert spl(success, shortest, driven) == pytest.approx(2 / 3)
    assert path_ratio(success, shortest, driven) is None
    assert path_ratio(np.array([False]), np.array([1.0]), np.array([1.0])) is None
    with pytest.raises(ConfigError, match="success"):
        spl(np.zeros(0, bool), np.zeros(0), np.zeros(0))


@given(LENGTHS)
def test_spl_is_at_most_the_success_rate_and_reaches_it_on_shortest_paths(episodes):
    success, shortest, driven = (np.array(column) for column in zip(*episodes, strict=True))
    rate = success.mean()
    assert 0 <= spl(success, shortest, driven) <= rate + 1e-12
    assert spl(success, shortest, shortest) == pytest.approx(rate)
    longer = spl(success, shortest, driven * 2)
    assert longer <= spl(success, shortest, driven) + 1e-12
    ratio = path_ratio(success, shortest, shortest)
    assert ratio is None if rate == 0 else ratio == pytest.approx(1.0)

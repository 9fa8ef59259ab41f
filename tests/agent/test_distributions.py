"""The action distribution against scipy.stats."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from segvisrl_jax.agent.distributions import DiagonalGaussian

STD = np.array([0.25, 1.7])


@pytest.fixture
def gaussian() -> DiagonalGaussian:
    mean = np.random.default_rng(0).normal(size=(5, 3, 2))
    return DiagonalGaussian(jnp.asarray(mean, jnp.float32), jnp.asarray(np.log(STD), jnp.float32))


def test_log_prob_is_that_of_scipy(gaussian: DiagonalGaussian) -> None:
    action = np.random.default_rng(1).normal(size=(5, 3, 2)) * 2
    expected = scipy.stats.norm(np.asarray(gaussian.mean), STD).logpdf(action).sum(-1)
    result = gaussian.log_prob(jnp.asarray(action, jnp.float32))
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-4)


def test_log_prob_is_not_clipped_to_the_range_of_the_wheels(gaussian: DiagonalGaussian) -> None:
    far, further = (gaussian.log_prob(jnp.full((5, 3, 2), value)) for value in (1.5, 2.5))
    expected = scipy.stats.norm(np.asarray(gaussian.mean), STD).logpdf(2.5).sum(-1)
    np.testing.assert_allclose(further, expected, rtol=1e-4)
    assert np.abs(np.asarray(far - further)).min() > 1e-2


def test_entropy_is_that_of_scipy(gaussian: DiagonalGaussian) -> None:
    expected = scipy.stats.norm(0, STD).entropy().sum()
    np.testing.assert_allclose(gaussian.entropy(), np.full((5, 3), expected), rtol=1e-5)


def test_samples_follow_the_distribution() -> None:
    gaussian = DiagonalGaussian(jnp.full((20_000, 2), 0.3), jnp.asarray(np.log(STD), jnp.float32))
    samples = np.asarray(gaussian.sample(key=jax.random.key(0)))
    for component, std in enumerate(STD):
        result = scipy.stats.kstest(samples[:, component], scipy.stats.norm(0.3, std).cdf)
        assert result.pvalue > 1e-3
    assert abs(np.corrcoef(samples.T)[0, 1]) < 0.03


def test_sample_is_decided_by_its_key(gaussian: DiagonalGaussian) -> None:
    first, again, other = (gaussian.sample(key=jax.random.key(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_the_mean_has_the_highest_density(gaussian: DiagonalGaussian) -> None:
    at_mean = gaussian.log_prob(gaussian.mean)
    beside = gaussian.log_prob(gaussian.mean + 0.01)
    assert bool(jnp.all(at_mean > beside))

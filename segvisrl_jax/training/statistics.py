"""What a number of trials says: intervals, paired tests, and the path metrics of navigation.

Plain NumPy and SciPy on counts and per-episode arrays; this file runs no episode.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from segvisrl_jax.config import require


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval for the rate behind ``successes`` out of ``trials``.

    It keeps close to its nominal coverage where the rate is near 0 or 1 and where trials are few,
    and it never leaves [0, 1].

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    Journal of the American Statistical Association 22 (1927); recommended by Brown, Cai and
    DasGupta, Statistical Science 16 (2001).

    Returns:
        (low, high), for example (0.744, 0.965) for 27 of 30.

    Raises:
        ConfigError: without trials, for a count outside [0, trials] or a confidence outside (0, 1).
    """
    require(trials >= 1, "trials", trials, "at least 1")
    require(0 <= successes <= trials, "successes", successes, f"in [0, trials = {trials}]")
    require(0 < confidence < 1, "confidence", confidence, "between 0 and 1")
    from scipy.stats import binomtest  # when first used: half a second, which a training needs not wait for

    interval = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


class McNemar(NamedTuple):
    """What a paired comparison of two methods found: the scenes that only one of them solved."""

    only_first: int
    only_second: int
    p_value: float


def mcnemar(first: Bool[np.ndarray, "E"], second: Bool[np.ndarray, "E"]) -> McNemar:
    """McNemar's exact test of two methods' success on the same scenes.

    Args:
        first: whether the first method solved each scene.
        second: whether the second method solved it; scene by scene the same ones.

    Returns:
        The numbers of discordant pairs (scenes that only the first, only the second solved), and the two-sided
        p-value of ``mcnemar_p_value``.

    Source: Q. McNemar, "Note on the sampling error of the difference between correlated proportions or
    percentages", Psychometrika 12 (1947), with the binomial distribution in place of its chi-squared limit.

    Raises:
        ConfigError: where the two have not the same number of scenes.
    """
    require(len(first) == len(second), "second", len(second), f"as many scenes as first, {len(first)}")
    only_first, only_second = int(np.sum(first & ~second)), int(np.sum(second & ~first))
    return McNemar(only_first, only_second, mcnemar_p_value(only_first, only_second))


def mcnemar_p_value(only_first: int, only_second: int) -> float:
    """McNemar's exact two-sided test: whether two methods differ on the same scenes.

    Args:
        only_first: scenes that only the first method solved.
        only_second: scenes that only the second method solved. Scenes that both or neither solved
            say nothing.

    Returns:
        The probability, if both were equally good, of a split at least this uneven; 1 where no
        scene differs.

    Source: Q. McNemar, Psychometrika 12 (1947), with the binomial distribution in place of its
    chi-squared limit.
    """
    require(only_first >= 0, "only_first", only_first, "0 or more")
    require(only_second >= 0, "only_second", only_second, "0 or more")
    differing = only_first + only_second
    if differing == 0:
        return 1.0
    from scipy.stats import binomtest

    return float(binomtest(only_first, differing, 0.5).pvalue)


def spl(
    success: Bool[np.ndarray, "E"],
    shortest_m: Float[np.ndarray, "E"],
    driven_m: Float[np.ndarray, "E"],
) -> float:
    """Success weighted by path length: the mean over episodes of S l / max(p, l), in [0, 1].

    Source: Anderson et al., "On evaluation of embodied navigation agents", arXiv:1807.06757, 2018.

    Args:
        success: S, whether each episode reached its goal.
        shortest_m: l, length of the shortest collision-free path
            (``shortest_path.shortest_path_m``). Where it is infinite, or both are 0, a success counts in full.
        driven_m: p, length of the path driven.

    Raises:
        ConfigError: without episodes.
    """
    require(len(success) >= 1, "success", len(success), "at least one episode")
    longest = np.maximum(driven_m, shortest_m)
    comparable = np.isfinite(longest) & (longest > 0)
    share = np.divide(shortest_m, longest, out=np.ones_like(longest), where=comparable)
    return float(np.mean(np.where(success, share, 0.0)))


def path_ratio(
    success: Bool[np.ndarray, "E"],
    shortest_m: Float[np.ndarray, "E"],
    driven_m: Float[np.ndarray, "E"],
) -> float | None:
    """Mean over the successful episodes of path driven / shortest path: 1 is best.

    Returns:
        The mean, or None where no successful episode has a positive, finite shortest path.
    """
    counted = success & np.isfinite(shortest_m) & np.isfinite(driven_m) & (shortest_m > 0)
    if not counted.any():
        return None
    return float(np.mean(driven_m[counted] / shortest_m[counted]))

"""Confidence intervals over trajectories: jackknife with Student's t, without random numbers.

The steps of a trajectory are dependent, so a trajectory is one observation. The percentile bootstrap is too short for
few of them; ``python bench/coverage.py`` prints the coverage of both.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, chdtrc, chdtri, stdtrit

from beliefscope.inspect.statistics.signals import Array

Numbers = NDArray[np.number[Any]]

LEVEL = 0.95
"""Nominal coverage."""

MIN_TRAJECTORIES = 5
"""Minimum number of trajectories for a confidence interval."""

SMALLEST = 1e-12
"""Lower limit of positive values before taking the logarithm."""


def too_few(trajectories: int) -> str | None:
    """Why there is no interval, or None."""
    if trajectories >= MIN_TRAJECTORIES:
        return None
    return f"too few episodes ({trajectories}; at least {MIN_TRAJECTORIES} needed)"


def nees_limit(n: int, level: float = LEVEL) -> float:
    """Largest mean NEES / n of a consistent filter with n components, at any number and dependence of steps.

    It is the mean of ``chi2_n / n`` beyond its quantile q of this level, ``P(chi2_(n + 2) > q) / P(chi2_n > q)``. Means
    of dependent variables exceed this expected shortfall with at most the probability of the tail, as it is
    subadditive (Acerbi and Tasche, Journal of Banking & Finance 26(7), 2002).
    """
    tail = 0.5 * (1.0 - level)
    return float(chdtrc(n + 2, chdtri(n, tail)) / tail)


def jackknife(sums: Array, statistic: Callable[[Array], Array], level: float = LEVEL) -> tuple[Array, Array, Array]:
    """Interval of a smooth function of sums over trajectories.

    ``f(S) -+ t_(R-1) sqrt((R - 1) / R sum_r (f(S - s_r) - mean)^2)``, S the sum of all s_r (Efron and Tibshirani, An
    Introduction to the Bootstrap, 1993, section 11.5).

    Args:
        sums: (R, ...) sums of R trajectories.
        statistic: sums (..., Q) -> values; called with ``S`` and with the R sums of all other trajectories.

    Returns:
        Value, low and high; the last two are NaN below ``MIN_TRAJECTORIES`` trajectories.
    """
    total, count = sums.sum(0), len(sums)
    value = np.asarray(statistic(total))
    if count < MIN_TRAJECTORIES:
        return value, np.full_like(value, np.nan), np.full_like(value, np.nan)
    others = statistic(total - sums)
    deviation = np.sqrt((count - 1) / count * np.square(others - others.mean(0)).sum(0))
    half = stdtrit(count - 1, 0.5 + level / 2.0) * deviation
    return value, value - half, value + half


def mean_interval(sums: Numbers, counts: Numbers, level: float = LEVEL) -> tuple[Array, Array, Array]:
    """Interval of the mean over all steps of a positive quantity whose trajectory means are skewed.

    The outer limits of two intervals of the logarithm: the jackknife, and the log-normal one of Cox with Student's t,
    ``m + s^2/2 -+ t_(R-1) sqrt(s^2/R + s^4 / (2 (R - 1)))``, m and s^2 mean and variance of the logarithms of the
    trajectory means (Olsson, Journal of Statistics Education 13(1), 2005). The first holds its level for light tails,
    the second for log-normal ones. Of trajectories that differ by more than factors of about e, such as those of a
    filter that diverges, the lower limit is at least that of the median, which the mean of a skewed quantity exceeds.

    Args:
        sums, counts: (R, ...) sum of the quantity and number of steps by trajectory; counts above 0.

    Returns:
        As ``jackknife``.
    """
    table = np.stack(np.broadcast_arrays(sums, counts), axis=-1).astype(np.float64)
    value, low, high = jackknife(table, _log_ratio, level)
    count = len(table)
    if count >= MIN_TRAJECTORIES:
        logs, shares = _log_ratio(table), table[..., 1] / table[..., 1].sum(0)
        size = 1.0 / np.square(shares).sum(0)  # R for equal counts
        mean = (shares * logs).sum(0)
        variance = (shares * np.square(logs - mean)).sum(0) * count / (count - 1)
        half = stdtrit(count - 1, 0.5 + level / 2.0) * np.sqrt(variance / size + variance**2 / (2.0 * (size - 1.0)))
        low = np.minimum(low, mean + variance / 2.0 - half)
        high = np.maximum(high, mean + variance / 2.0 + half)
        below = int((bdtr(np.arange(count), count, 0.5) <= 0.5 * (1.0 - level)).sum())
        if below:
            low = np.where(variance > 1.0, np.maximum(low, np.sort(logs, axis=0)[below - 1]), low)
    return np.exp(value), np.exp(low), np.exp(high)


def _log_ratio(table: Array) -> Array:
    return np.log(np.maximum(table[..., 0], SMALLEST) / table[..., 1])


def correlation_sums(x: Array, y: Array) -> Array:
    """(6, C) sufficient statistics of the correlation of pairs (C, S): sums of 1, x, y, x^2, y^2, x y."""
    return np.stack([np.ones_like(x), x, y, x * x, y * y, x * y]).sum(-1)


def correlate(sums: Array) -> tuple[Array, Array, Array]:
    """Pearson correlations of pooled steps with 95 % intervals over trajectories, on Fisher's scale ``artanh r``.

    For binary x or y this is the point-biserial correlation.

    Args:
        sums: (R, ..., 6, C) ``correlation_sums`` of R trajectories and C pairs.

    Returns:
        Value, low and high, (..., C) each. NaN where x or y is constant; intervals need ``MIN_TRAJECTORIES``
        trajectories.
    """
    return correlation_interval(sums, _correlation)


def correlation_interval(
    sums: Array, correlation: Callable[[Array], Array], level: float = LEVEL
) -> tuple[Array, Array, Array]:
    """As ``jackknife`` for a value from -1 to 1, on Fisher's scale ``artanh r``."""

    def fisher(part: Array) -> Array:
        return np.arctanh(np.clip(correlation(part), -1.0 + 1e-9, 1.0 - 1e-9))

    with np.errstate(invalid="ignore"):
        value, low, high = jackknife(sums, fisher, level)
    return np.tanh(value), np.tanh(low), np.tanh(high)


def _correlation(sums: Array) -> Array:
    """(..., 6, C) to (..., C); NaN where x or y is constant."""
    count, x, y, xx, yy, xy = np.moveaxis(sums, -2, 0)
    variance_x, variance_y = count * xx - x * x, count * yy - y * y
    # Rounding leaves a small difference of equal terms.
    constant = (variance_x <= 1e-9 * count * xx) | (variance_y <= 1e-9 * count * yy)
    return np.where(constant, np.nan, (count * xy - x * y) / np.sqrt(np.where(constant, 1.0, variance_x * variance_y)))

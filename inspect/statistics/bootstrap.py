"""Bootstrap over whole trajectories: sums of resampled ones, and correlations of their steps with intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RESAMPLES, SEED = 2000, 0

FEWEST = 5
"""Trajectories that an interval is made from."""


def sums_of(x: Array, y: Array) -> Array:
    """(6, C): all that a correlation needs of one trajectory's pairs (C, S): sums of 1, x, y, x^2, y^2, x y."""
    return np.stack([np.ones_like(x), x, y, x * x, y * y, x * y]).sum(-1)


def correlate(sums: Array, seed: int = SEED) -> tuple[Array, Array, Array]:
    """Pearson correlations of pooled steps, and their 95 % percentile bootstrap intervals over trajectories.

    Where x or y is 0 or 1, this is the point-biserial correlation. Steps of one trajectory depend on one another, so
    whole trajectories are drawn: a resample is how often each comes up, times its sums.

    Args:
        sums: (R, 6, C) of R trajectories and C pairs (``sums_of``).

    Returns:
        (C,) each: value, NaN where x or y never changes; low, high, NaN too of fewer than ``FEWEST`` trajectories.
    """
    value, trajectories = _correlation(sums.sum(0)), len(sums)
    if trajectories < FEWEST:
        return value, np.full_like(value, np.nan), np.full_like(value, np.nan)
    drawn = _correlation(resampled(sums, seed))
    # A percentile of nothing but NaN would warn.
    low, high = np.nanpercentile(np.where(np.isnan(value), 0.0, drawn), [2.5, 97.5], axis=0)
    return value, np.where(np.isnan(value), np.nan, low), np.where(np.isnan(value), np.nan, high)


def resampled(sums: Array, seed: int = SEED) -> Array:
    """(RESAMPLES, ...): sums (R, ...) of R trajectories, added up over R that are drawn with replacement."""
    trajectories = len(sums)
    drawn = np.random.default_rng(seed).multinomial(trajectories, np.full(trajectories, 1.0 / trajectories), RESAMPLES)
    return np.tensordot(drawn.astype(np.float64), sums, axes=1)


def _correlation(sums: Array) -> Array:
    """(..., 6, C) to (..., C); NaN where x or y does not change."""
    count, x, y, xx, yy, xy = np.moveaxis(sums, -2, 0)
    of_x, of_y = count * xx - x * x, count * yy - y * y
    # Rounding leaves a little of what is a difference of equals.
    flat = (of_x <= 1e-9 * count * xx) | (of_y <= 1e-9 * count * yy)
    return np.where(flat, np.nan, (count * xy - x * y) / np.sqrt(np.where(flat, 1.0, of_x * of_y)))

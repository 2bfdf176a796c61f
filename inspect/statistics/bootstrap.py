"""Bootstrap over trajectories: resampled sums, and correlations with confidence intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RESAMPLES, SEED = 2000, 0

MIN_TRAJECTORIES = 5
"""Minimum number of trajectories for a confidence interval."""


def correlation_sums(x: Array, y: Array) -> Array:
    """(6, C) sufficient statistics of the correlation of pairs (C, S): sums of 1, x, y, x^2, y^2, x y."""
    return np.stack([np.ones_like(x), x, y, x * x, y * y, x * y]).sum(-1)


def correlate(sums: Array, seed: int = SEED) -> tuple[Array, Array, Array]:
    """Pearson correlations of pooled steps with 95 % percentile bootstrap intervals over trajectories.

    For binary x or y this is the point-biserial correlation. Whole trajectories are resampled because the steps of a
    trajectory are dependent.

    Args:
        sums: (R, 6, C) ``correlation_sums`` of R trajectories and C pairs.

    Returns:
        Value, low and high, (C,) each. NaN where x or y is constant; intervals need ``MIN_TRAJECTORIES`` trajectories.
    """
    value, trajectories = _correlation(sums.sum(0)), len(sums)
    if trajectories < MIN_TRAJECTORIES:
        return value, np.full_like(value, np.nan), np.full_like(value, np.nan)
    samples = _correlation(resample_sums(sums, seed))
    # nanpercentile warns about slices with NaN only.
    low, high = np.nanpercentile(np.where(np.isnan(value), 0.0, samples), [2.5, 97.5], axis=0)
    return value, np.where(np.isnan(value), np.nan, low), np.where(np.isnan(value), np.nan, high)


def resample_sums(sums: Array, seed: int = SEED) -> Array:
    """(RESAMPLES, ...): sums (R, ...) of R trajectories, added over R trajectories drawn with replacement."""
    trajectories = len(sums)
    counts = np.random.default_rng(seed).multinomial(trajectories, np.full(trajectories, 1.0 / trajectories), RESAMPLES)
    return np.tensordot(counts.astype(np.float64), sums, axes=1)


def _correlation(sums: Array) -> Array:
    """(..., 6, C) to (..., C); NaN where x or y is constant."""
    count, x, y, xx, yy, xy = np.moveaxis(sums, -2, 0)
    variance_x, variance_y = count * xx - x * x, count * yy - y * y
    # Rounding leaves a small difference of equal terms.
    constant = (variance_x <= 1e-9 * count * xx) | (variance_y <= 1e-9 * count * yy)
    return np.where(constant, np.nan, (count * xy - x * y) / np.sqrt(np.where(constant, 1.0, variance_x * variance_y)))

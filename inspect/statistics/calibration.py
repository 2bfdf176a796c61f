"""How well stated distributions fit what was true: calibration, CRPS, whiteness; of Gaussians and of particles.

Arrays are vectorised over any leading axes. Errors and deviations are differences of states, angles wrapped.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, ndtr

Array = NDArray[np.float64]

LEVELS = np.linspace(0.05, 0.95, 19)
"""Levels of the regions that calibration curves count in."""

LAGS = 10
"""Of the whiteness test."""


def gaussian_level(squared: Array, n: int) -> Array:
    """Level of the ellipsoid on whose surface the truth lies: chi-square probability of ``e^T S^-1 e``, n components.

    Uniform between 0 and 1 where the Gaussian is right.
    """
    return chdtr(n, squared)


def particle_level(deviation: Array, weights: Array, error: Array, covariance: Array) -> Array:
    """The same of a particle set: share of its weight nearer to its mean than the truth is, by its own covariance.

    Args:
        deviation: (..., M, n) particles minus the set's mean. weights: (..., M), sum 1.
        error: (..., n) mean minus truth. covariance: (..., n, n).
    """
    precision = np.linalg.inv(covariance)
    distance = (deviation @ precision * deviation).sum(-1)
    truth = (error[..., None, :] @ precision @ error[..., None])[..., 0]
    return (weights * (distance < truth)).sum(-1)


def calibration_curve(level: Array) -> Array:
    """(P,): share of steps whose truth lies in the region of each of ``LEVELS``. Levels (S,)."""
    return (level[:, None] <= LEVELS).mean(0)


def gaussian_crps(error: Array, deviation: Array) -> Array:
    """Continuous ranked probability score of N(m, s^2), in the unit of the error; |error| where s = 0.

    ``s (z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi))`` with ``z = error / s`` (Gneiting and Raftery 2007, eq. 21).

    Args:
        error: (...) mean minus truth. deviation: (...) s, above 0.
    """
    z = error / deviation
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return deviation * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi))


def particle_crps(deviation: Array, weights: Array) -> Array:
    """CRPS of weighted samples, ``E|X - y| - E|X - X'| / 2``: O(M log M), since sorting orders the second term.

    Args:
        deviation: (..., M) samples minus truth. weights: (..., M), sum 1.
    """
    order = np.argsort(deviation, axis=-1)
    x, w = np.take_along_axis(deviation, order, -1), np.take_along_axis(weights, order, -1)
    # Half the mean distance of a pair: sum_i w_i x_i (weight below x_i - weight above it).
    below_minus_above = 2.0 * np.cumsum(w, axis=-1) - w - w.sum(-1, keepdims=True)
    return (w * np.abs(x)).sum(-1) - (w * x * below_minus_above).sum(-1)


def ljung_box(series: Array, lags: int = LAGS) -> tuple[Array, Array]:
    """Ljung and Box's statistic of series (T, C), and their autocorrelations at lag 1: both (C,).

    ``Q = T (T + 2) sum_h r_h^2 / (T - h)``, chi-square with ``lags`` degrees of freedom where a series is white.
    """
    steps = len(series)
    x = series - series.mean(0)
    r = np.stack([(x[lag:] * x[:-lag]).sum(0) for lag in range(1, lags + 1)]) / np.square(x).sum(0)
    left = steps - np.arange(1, lags + 1)[:, None]
    return steps * (steps + 2) * (r**2 / left).sum(0), r[0]

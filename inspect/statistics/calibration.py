"""Calibration, CRPS and whiteness of Gaussian and particle beliefs.

Functions are vectorised over leading axes. Errors and deviations are differences of states with angles wrapped.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtr, ndtr

from beliefscope.inspect.statistics.signals import Array

LEVELS = np.linspace(0.05, 0.95, 19)
"""Levels of the credible regions of calibration curves."""

LAGS = 10
"""Lags of the whiteness test."""


def gaussian_level(squared: Array, n: int) -> Array:
    """Level of the ellipsoid through the true state: chi-square probability of ``e^T S^-1 e`` with n components.

    Uniform between 0 and 1 for a calibrated Gaussian. squared: (...); the result has its shape.
    """
    return chdtr(n, squared)


def particle_level(deviation: Array, weights: Array, error: Array, covariance: Array) -> Array:
    """``gaussian_level`` of a particle set: share of weight closer to its mean than the true state (Mahalanobis).

    Args:
        deviation: (..., M, n) particles minus their mean.
        weights: (..., M), sum 1.
        error: (..., n) mean minus true state.
        covariance: (..., n, n) covariance of the particles.
    """
    precision = np.linalg.inv(covariance)
    distance = (deviation @ precision * deviation).sum(-1)
    truth = (error[..., None, :] @ precision @ error[..., None])[..., 0]
    return (weights * (distance < truth)).sum(-1)


def calibration_curve(level: Array) -> Array:
    """(P,): share of steps whose level (S,) is below each of ``LEVELS``."""
    return (level[:, None] <= LEVELS).mean(0)


def gaussian_crps(error: Array, deviation: Array) -> Array:
    """Continuous ranked probability score of N(m, s^2), in the unit of the error; |error| where s = 0.

    ``s (z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi))`` with ``z = error / s`` (Gneiting and Raftery 2007, eq. 21).

    Args:
        error: (...) mean minus true value.
        deviation: (...) s, above 0.
    """
    z = error / deviation
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return deviation * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi))


def particle_crps(deviation: Array, weights: Array) -> Array:
    """CRPS of weighted samples, ``E|X - y| - E|X - X'| / 2``, in O(M log M) by sorting.

    Args:
        deviation: (..., M) samples minus true value.
        weights: (..., M), sum 1.
    """
    order = np.argsort(deviation, axis=-1)
    x, w = np.take_along_axis(deviation, order, -1), np.take_along_axis(weights, order, -1)
    # Half the mean distance of a pair: sum_i w_i x_i (weight below x_i - weight above x_i).
    below_minus_above = 2.0 * np.cumsum(w, axis=-1) - w - w.sum(-1, keepdims=True)
    return (w * np.abs(x)).sum(-1) - (w * x * below_minus_above).sum(-1)


def ljung_box(series: Array, lags: int = LAGS) -> tuple[Array, Array]:
    """Ljung-Box statistic and autocorrelation at lag 1 of series (T, C); both (C,).

    ``Q = T (T + 2) sum_h r_h^2 / (T - h)``, chi-square with ``lags`` degrees of freedom for white series. Both are NaN
    for a constant series, which has no autocorrelation.
    """
    steps = len(series)
    x = series - series.mean(0)
    # A constant such as 0.1 differs from its mean by rounding.
    power = np.where(np.ptp(series, axis=0) > 0.0, np.square(x).sum(0), np.nan)
    r = np.stack([(x[lag:] * x[:-lag]).sum(0) for lag in range(1, lags + 1)]) / power
    pairs = steps - np.arange(1, lags + 1)[:, None]
    return steps * (steps + 2) * (r**2 / pairs).sum(0), r[0]

"""Covariances that can be inverted, whatever the units of the state: a particle set may have collapsed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FLOOR = 1e-8
"""Part of a component's usual variance, or of its own if that is larger, that is added to its variances."""

SMALLEST = 1e-30
"""Variance of a component that has none in any covariance."""


def with_floor(covariance: NDArray[Any], usual: NDArray[Any] | None = None) -> NDArray[np.float64]:
    """Covariances (..., n, n) in float64, plus ``FLOOR`` times the larger of own and usual variance on the diagonal.

    A change of a component's unit changes the result by the same factors.

    Args:
        usual: (n,) variances. Default: ``usual_variances`` of these covariances.
    """
    covariance = np.asarray(covariance, np.float64)
    usual = usual_variances(covariance) if usual is None else usual
    larger = np.maximum(usual, np.diagonal(covariance, axis1=-2, axis2=-1))
    return covariance + np.maximum(FLOOR * larger, SMALLEST)[..., None] * np.eye(covariance.shape[-1])


def usual_variances(covariance: NDArray[Any]) -> NDArray[np.float64]:
    """(n,) median of the positive variances of each component in covariances (..., n, n); 0 if there are none."""
    variances = np.diagonal(covariance, axis1=-2, axis2=-1).reshape(-1, covariance.shape[-1]).astype(np.float64)
    return np.array([np.median(v[v > 0.0]) if (v > 0.0).any() else 0.0 for v in variances.T])

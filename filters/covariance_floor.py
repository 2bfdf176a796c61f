"""Covariances that can be inverted, whatever the units of the state, and the check of covariances."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beliefscope.datasets.text import percent

FLOOR = 1e-8
"""Part of a component's usual variance, or of its own if that is larger, that is added to its variances."""

SMALLEST = 1e-30
"""Variance of a component that has none in any covariance: a particle set may have collapsed."""

INDEFINITE = 1e-3
"""Eigenvalue of a correlation matrix below zero, and difference from its transpose, that are not rounding."""


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


def is_covariance(matrices: NDArray[Any]) -> NDArray[np.bool_]:
    """(...): whether matrices (..., n, n) are symmetric with positive variances, and not ``is_indefinite``.

    Unknown and infinite matrices are not.
    """
    matrices = np.where(np.isfinite(matrices), matrices, np.nan)
    correlations = _correlations(matrices)
    is_symmetric = (np.abs(correlations - np.swapaxes(correlations, -1, -2)) <= INDEFINITE).all((-2, -1))
    has_variances = (np.diagonal(matrices, axis1=-2, axis2=-1) > 0.0).all(-1)
    return np.asarray(is_symmetric & has_variances & ~is_indefinite(matrices))


def without_invalid(trajectories: Sequence[Tensor], firsts: Sequence[int]) -> list[Tensor]:
    """Covariances (T, n, n) of each episode, invalid ones replaced by NaN. Warns with their share of the counted steps.

    Episodes without any covariance, NaN, cause no warning.

    Args:
        firsts: first counted step of each episode.
    """
    valid = [is_covariance(covariances.numpy()) for covariances in trajectories]
    counted = np.concatenate([mask[first:] for mask, first in zip(valid, firsts, strict=True)])
    if not counted.all() and not all(covariances.isnan().all() for covariances in trajectories):
        warnings.warn(
            f"covariances are not symmetric and positive definite in {percent(1.0 - counted.mean(), '.3g')} of the "
            f"steps; NLL, NEES/n and 95 % coverage are {'those of the other steps' if counted.any() else 'unknown'}",
            stacklevel=3,
        )
    return [
        c.where(torch.from_numpy(mask)[:, None, None], torch.nan) for c, mask in zip(trajectories, valid, strict=True)
    ]


def is_indefinite(covariance: NDArray[Any]) -> NDArray[np.bool_]:
    """(...): whether a covariance (..., n, n) has a negative variance, or correlations that no errors have.

    The tolerance covers the rounding of single precision. Unknown covariances, NaN, are not indefinite.
    """
    correlations, variances = _correlations(covariance), np.diagonal(covariance, axis1=-2, axis2=-1)
    known = np.isfinite(correlations).all((-2, -1))
    eigenvalues = np.linalg.eigvalsh(np.where(known[..., None, None], correlations, 1.0))
    return np.asarray(known & ((variances < 0.0).any(-1) | (eigenvalues[..., 0] < -INDEFINITE)))


def _correlations(matrices: NDArray[Any]) -> NDArray[Any]:
    """Matrices (..., n, n) divided by the standard deviations of their positive variances."""
    variance = np.diagonal(matrices, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    return matrices / (scale[..., :, None] * scale[..., None, :])

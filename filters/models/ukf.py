"""Unscented Kalman filters: extended Kalman filters with an unscented prediction (not in the paper)."""

from __future__ import annotations

import torch
from torch import Tensor

from beliefscope.filters.belief import Gaussian
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.fusion import symmetric

ALPHA, BETA, KAPPA = 1.0, 2.0, 0.0
"""Parameters of the scaled transform: no weight is negative, so that covariances are positive definite; beta is 2 for
Gaussians."""


def sigma_points(belief: Gaussian) -> Tensor:
    """The mean and n points on either side of it at ``sqrt(n + lambda)`` standard deviations: (..., 2 n + 1, n)."""
    n = belief.mean.shape[-1]
    # Row i is column i of the Cholesky factor, scaled: n + lambda = alpha^2 (n + kappa).
    offsets = ALPHA * (n + KAPPA) ** 0.5 * torch.linalg.cholesky(belief.covariance).transpose(-1, -2)
    mean = belief.mean.unsqueeze(-2)
    return torch.cat([mean, mean + offsets, mean - offsets], dim=-2)


def unscented(points: Tensor) -> Gaussian:
    """Mean and covariance of transformed sigma points (..., 2 n + 1, n).

    Weights of the scaled unscented transform (Wan and van der Merwe, "The Unscented Kalman Filter for Nonlinear
    Estimation", 2000): ``lambda / (n + lambda)`` for the centre, with ``1 - alpha^2 + beta`` added in the covariance,
    and ``1 / (2 (n + lambda))`` for the others.
    """
    n = points.shape[-1]
    spread = ALPHA**2 * (n + KAPPA)
    mean_weights = points.new_full((2 * n + 1,), 0.5 / spread)
    mean_weights[0] = 1.0 - n / spread
    covariance_weights = mean_weights.clone()
    covariance_weights[0] += 1.0 - ALPHA**2 + BETA
    mean = mean_weights @ points
    deviation = points - mean.unsqueeze(-2)
    return Gaussian(mean, (deviation * covariance_weights.unsqueeze(-1)).transpose(-1, -2) @ deviation)


class UnscentedKalmanFilter(ExtendedKalmanFilter):
    """A bank of unscented Kalman filters with the virtual sensors, updates and fusion of the EKF.

    The update needs no sigma points, since virtual sensors observe the state itself: H = I.
    """

    def predict(self, belief: Gaussian, control_part: Tensor) -> Gaussian:
        predicted = unscented(self.dynamics(sigma_points(belief), control_part.unsqueeze(-2)))
        return Gaussian(predicted.mean, symmetric(predicted.covariance) + torch.diag_embed(self.dynamics.noise**2))

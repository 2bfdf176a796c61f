"""Rules to fuse K unimodal beliefs or likelihoods, as pure functions."""

from __future__ import annotations

from functools import reduce
from math import exp
from typing import Literal

import torch
from torch import Tensor

from beliefscope.filters.angles import Angles
from beliefscope.filters.belief import Gaussian

CovarianceRule = Literal["paper", "moments"]

LEAST_WEIGHT = exp(-40.0)
"""Smallest weight of a filter, whose square is still a normal number in single precision."""


def in_one_turn(bank: Gaussian, angles: Angles) -> Gaussian:
    """The bank (..., K, n) with angles at most half a turn from those of its first belief."""
    if not angles.indices:
        return bank
    return Gaussian(angles.near(bank.mean, bank.mean[..., :1, :]), bank.covariance)


def product_of_experts(bank: Gaussian, present: Tensor | None = None) -> Gaussian:
    """Product of K Gaussians (N, K, n): ``S = (sum S_k^-1)^-1``, ``m = S sum S_k^-1 m_k`` (Lee et al., eq. 10, 11).

    present: (N, K) bool, which to include. If none is, the K predictions, each to the power 1 / K, so that they do not
    count as K independent pieces of evidence.
    """
    precision = torch.linalg.inv(bank.covariance)
    if present is not None:
        precision = precision * powers_of_present(present)[..., None, None]
    covariance = symmetric(torch.linalg.inv(precision.sum(-3)))
    information = (precision @ bank.mean.unsqueeze(-1)).sum(-3)
    return Gaussian((covariance @ information).squeeze(-1), covariance)


def powers_of_present(present: Tensor) -> Tensor:
    """Powers (..., K) of the experts of a product: 1 if ``present`` (..., K), else 0; all 1 / K if none is."""
    return torch.where(present.any(-1, keepdim=True), present.float(), 1.0 / present.shape[-1])


def weighted_average(bank: Gaussian, log_weights: Tensor, rule: CovarianceRule = "paper") -> Gaussian:
    """Crossmodal weights per component: ``m = sum b_k * m_k / sum b_k`` (Lee et al., eq. 12, 13).

    ``paper``: ``S = sum B_k * S_k / sum B_k``, all elementwise, ``B_k = n b_k b_k^T``. It may be indefinite,
    since each entry is averaged with its own weights; its correlations are then clipped (``positive_definite``).
    The rule also ignores the disagreement of the modalities.
    ``moments``: the covariance of the mixture with these weights, which adds the spread of the means; always positive
    definite.

    Args:
        bank: mean (N, K, n), covariance (N, K, n, n). log_weights: (N, K, n), log beta.
    """
    beta = torch.softmax(log_weights, dim=-2)
    mean = (beta * bank.mean).sum(-2)
    if rule == "moments":
        root = beta.sqrt()
        spread = bank.mean - mean.unsqueeze(-2)
        inner = bank.covariance + spread.unsqueeze(-1) * spread.unsqueeze(-2)
        return Gaussian(mean, symmetric((root.unsqueeze(-1) * root.unsqueeze(-2) * inner).sum(-3)))
    # With this minimum, the ratio stays finite for one-hot weights that differ between components (else 0 / 0).
    beta = beta.clamp_min(LEAST_WEIGHT)
    outer = beta.unsqueeze(-1) * beta.unsqueeze(-2)
    return Gaussian(mean, positive_definite((outer * bank.covariance).sum(-3) / outer.sum(-3)))


def powers(log_weights: Tensor, present: Tensor | None = None) -> Tensor:
    """Powers ``K beta_k`` (N, K, n) of K experts, which sum to the number K of used experts.

    Equal weights give power 1. An expert with beta zero, or not in ``present`` (N, K), is not used.
    """
    used = (log_weights > -torch.inf).any(-1, keepdim=True)
    if present is not None:
        used = used & present.unsqueeze(-1)
    return torch.softmax(log_weights, dim=-2) * used.sum(-2, keepdim=True) * used


def weighted_product(bank: Gaussian, power: Tensor) -> Gaussian:
    """Product of K Gaussians (N, K, n) to the powers (N, K, n): precisions add, scaled by the roots of the powers.

    ``S^-1 = sum_k D_k S_k^-1 D_k``, ``m = S sum_k D_k S_k^-1 D_k m_k``, ``D_k = diag(sqrt(power_k))``.
    """
    root = power.sqrt()
    precision = torch.linalg.inv(bank.covariance) * root.unsqueeze(-1) * root.unsqueeze(-2)
    covariance = symmetric(torch.linalg.inv(precision.sum(-3)))
    information = (precision @ bank.mean.unsqueeze(-1)).sum(-3)
    return Gaussian((covariance @ information).squeeze(-1), covariance)


def mixture(log_likelihood: Tensor, log_weights: Tensor | None) -> Tensor:
    """``log sum_k b_k p_k`` (eq. 14, 15): log-likelihoods (..., K, M) and log beta (..., K, 1) to (..., M)."""
    weighted = log_likelihood if log_weights is None else log_likelihood + log_weights
    return reduce(torch.logaddexp, weighted.unbind(-2))  # for a few models faster than logsumexp


def only_present(log_likelihood: Tensor, present: Tensor) -> Tensor:
    """Log-likelihoods (N, K, M), -inf for models that are not ``present`` (N, K); uniform if none is."""
    none = ~present.any(-1, keepdim=True)
    masked = log_likelihood.masked_fill(~present.unsqueeze(-1), -torch.inf)
    return masked.masked_fill(none.unsqueeze(-1), 0.0)


def symmetric(matrix: Tensor) -> Tensor:
    """The symmetric part of (..., n, n)."""
    return 0.5 * (matrix + matrix.transpose(-1, -2))


def positive_definite(covariance: Tensor) -> Tensor:
    """Clips the correlations of matrices (..., n, n) that are not positive definite to 0.95 / (n - 1).

    A matrix with unit diagonal and off-diagonal entries below 1 / (n - 1) is diagonally dominant and hence positive
    definite.
    """
    n = covariance.shape[-1]
    if n == 1:
        return covariance
    info = torch.linalg.cholesky_ex(covariance.detach()).info
    if not info.any():
        return covariance
    scale = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).sqrt()
    outer = scale.unsqueeze(-1) * scale.unsqueeze(-2)
    limit = 0.95 / (n - 1)
    diagonal = torch.eye(n, dtype=torch.bool, device=covariance.device)
    clipped = torch.where(diagonal, covariance, (covariance / outer).clamp(-limit, limit) * outer)
    return torch.where((info > 0)[..., None, None], clipped, covariance)

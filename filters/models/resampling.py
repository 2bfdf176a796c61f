"""Resampling of particles: ancestors and the weights after resampling."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from beliefscope.filters.models import common_random_numbers

Resampling = Literal["systematic", "hard", "soft"]


def resample(
    log_weights: Tensor, rule: Resampling, soft_share: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Ancestors (N, M) int64 and the log-weights (N, M) after resampling, normalised: logsumexp over M is 0.

    ``systematic`` and ``hard`` (multinomial) sample from the weights w and make all weights equal; no gradient passes.
    ``soft`` samples from ``q = a w + (1 - a) / M`` and corrects by the importance weights w / q, which carry gradients
    (Karkus et al., "Particle Filter Networks", 2018).

    Args:
        log_weights: (N, M), normalised. soft_share: a. generator: on the same device.
    """
    if rule == "systematic":
        return systematic(log_weights.detach(), generator), uniform(log_weights)
    if rule == "hard":
        return multinomial(log_weights.detach(), generator), uniform(log_weights)
    ancestors, corrected = soft(log_weights, soft_share, generator)
    return ancestors, torch.log_softmax(corrected, dim=-1)


def systematic(log_weights: Tensor, generator: torch.Generator) -> Tensor:
    """Ancestors (N, M) int64 by systematic resampling: one uniform number per set, M evenly spaced pointers.

    Particle i is sampled floor(M w_i) or ceil(M w_i) times, M w_i in expectation.

    Args:
        log_weights: (N, M), normalised. generator: on the same device.
    """
    count = log_weights.shape[-1]
    offset = common_random_numbers.uniform((len(log_weights), 1), generator)
    pointers = (torch.arange(count, device=log_weights.device) + offset) / count
    return select_by_weight(log_weights, pointers)


def multinomial(log_weights: Tensor, generator: torch.Generator) -> Tensor:
    """Ancestors (N, M) int64, independent: particle i with probability w_i. Arguments as in ``systematic``."""
    return select_by_weight(log_weights, common_random_numbers.uniform(log_weights.shape, generator))


def soft(log_weights: Tensor, share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Soft resampling: ancestors (N, M) and ``log(w / (q M))`` of each, whose exponentials sum to 1 in expectation.

    The weighted sum of any function over the particles has the same expectation as before.
    """
    count = log_weights.shape[-1]
    uniform_part = torch.full_like(log_weights, math.log1p(-share) - math.log(count) if share < 1.0 else -math.inf)
    log_proposal = torch.logaddexp(log_weights + math.log(share), uniform_part)
    ancestors = systematic(log_proposal.detach(), generator)
    return ancestors, (log_weights - log_proposal).gather(-1, ancestors) - math.log(count)


def select_by_weight(log_weights: Tensor, pointers: Tensor) -> Tensor:
    """Index of the particle whose interval of the cumulative weights contains each pointer (N, M) in [0, 1)."""
    cumulative = log_weights.exp().cumsum(-1)
    # Rounding may leave the last sum slightly below 1; normalise so that every pointer falls inside.
    cumulative = cumulative / cumulative[:, -1:]
    return torch.searchsorted(cumulative, pointers, right=True).clamp_max(log_weights.shape[-1] - 1)


def uniform(log_weights: Tensor) -> Tensor:
    """Equal log-weights, normalised, of the same shape (N, M)."""
    return torch.full_like(log_weights, -math.log(log_weights.shape[-1]))


def effective_sample_size(log_weights: Tensor) -> Tensor:
    """``1 / sum w_i^2`` of normalised log-weights (..., M) to (...)."""
    return (-torch.logsumexp(2.0 * log_weights, dim=-1)).exp()

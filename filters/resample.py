"""Resampling of particles."""

from __future__ import annotations

import torch
from torch import Tensor


def systematic(log_weights: Tensor, generator: torch.Generator) -> Tensor:
    """Ancestors (N, M) int64 by systematic resampling: one uniform number a set, M evenly spaced pointers.

    Particle i is drawn floor(M w_i) or ceil(M w_i) times, M w_i in expectation.

    Args:
        log_weights: (N, M), normalised. generator: of the same device.
    """
    count = log_weights.shape[-1]
    offset = torch.rand(log_weights.shape[0], 1, generator=generator, device=log_weights.device)
    pointers = (torch.arange(count, device=log_weights.device) + offset) / count
    cumulative = log_weights.exp().cumsum(-1)
    # Rounding may leave the last sum a little off 1; dividing keeps every pointer inside.
    cumulative = cumulative / cumulative[:, -1:]
    return torch.searchsorted(cumulative, pointers, right=True).clamp_max(count - 1)


def effective_sample_size(log_weights: Tensor) -> Tensor:
    """``1 / sum w_i^2`` of normalised log-weights (..., M) to (...)."""
    return (-torch.logsumexp(2.0 * log_weights, dim=-1)).exp()

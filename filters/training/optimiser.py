"""Parameter groups of the optimiser, and one step of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from beliefscope.filters.filter import Filter

NOISE_SCALES = ("dynamics.log_noise", "log_scale", "log_bias", "memory", "log_motion")
"""Parameters that are logarithms of noise, or of its correlation."""


def parameter_groups(filter_: Filter, trained: Sequence[nn.Parameter], rate: float) -> list[dict[str, Any]]:
    """Logarithms of noise, which scale all else, train at ten times the rate and without decay."""
    noise = [p for n, p in filter_.named_parameters() if n in NOISE_SCALES and p.requires_grad]
    networks = [p for p in trained if all(p is not q for q in noise)]
    return [{"params": networks}, {"params": noise, "lr": 10 * rate, "weight_decay": 0.0}]


def optimiser_step(
    optimiser: torch.optim.Optimizer, parameters: Sequence[nn.Parameter], loss: Callable[[str], Tensor]
) -> float:
    """One step with clipped gradients, skipped if a gradient overflowed; returns the loss."""
    optimiser.zero_grad(set_to_none=True)
    value = loss("train")
    value.backward()
    if torch.isfinite(nn.utils.clip_grad_norm_(parameters, 5.0)):
        optimiser.step()
    return float(value.detach())

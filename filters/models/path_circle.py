"""The circle on which a hand moves while it holds an object with a fixed axis: features of haptics."""

from __future__ import annotations

import torch
from torch import Tensor

MEMORY = 199
"""Past steps whose positions are used."""

FEATURES = 6
"""Number of features per step: centre and shape."""

PRIOR = 1e-3
"""Weight of the prior centre in the fit, m^2: that of a path with this sum of squared deviations."""


def circle(path: Tensor, contact: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Centre (T, N, 2) of the circle through each step's path so far, m, and shape (T, N, 4) of that path.

    The algebraic fit (Kasa, 1976) of ``|q|^2 = 2 c q + k`` minimises its squared residuals over positions q in contact
    and ``PRIOR |c - prior|^2``. The shape shows along which direction the centre is known: sums of squares and products
    of the path's deviations from its mean, relative to their trace plus ``PRIOR``, and the logarithm of the latter over
    ``PRIOR``.

    Args:
        path: (T, N, 2) positions, m. contact: (T, N) bool. prior: (2,) centre for a path without curvature, m.
    """
    weight = contact.double().unsqueeze(-1)
    q = path.double() - prior
    square = q.square().sum(-1, keepdim=True)
    count = recent_sums(weight).clamp_min(1.0)
    mean, mean_square = recent_sums(weight * q) / count, recent_sums(weight * square) / count
    products = recent_sums(weight.unsqueeze(-1) * q.unsqueeze(-1) * q.unsqueeze(-2))
    spread = products - count.unsqueeze(-1) * mean.unsqueeze(-1) * mean.unsqueeze(-2)
    moment = recent_sums(weight * square * q) - count * mean_square * mean
    identity = torch.eye(2, dtype=q.dtype, device=q.device)
    centre = torch.linalg.solve(2.0 * spread + PRIOR * identity, moment)
    size = spread.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True).clamp_min(0.0) + PRIOR
    direction = torch.stack([spread[..., 0, 0], spread[..., 1, 1], spread[..., 0, 1]], dim=-1) / size
    shape = torch.cat([direction, (size / PRIOR).log()], dim=-1)
    return (centre + prior).to(path.dtype), shape.to(path.dtype)


def recent_sums(values: Tensor) -> Tensor:
    """Sums of values (T, ...) over each step and the ``MEMORY`` steps before."""
    total = torch.cat([torch.zeros_like(values[:1]), values.cumsum(0)])
    last = torch.arange(1, len(total), device=values.device)
    return total[last] - total[(last - 1 - MEMORY).clamp_min(0)]

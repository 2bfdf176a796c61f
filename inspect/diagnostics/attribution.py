"""Attribution methods of captum: integrated gradients with error control, and occlusion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.engine import Progress

TOLERANCE = 0.02
"""Maximum error of the sum of integrated gradients, relative to the change that they explain."""

SEGMENTS, POINTS, MAX_POINTS = 8, 4, 2048
"""Initial segments of the path from a baseline; gradients per segment; maximum number of gradients."""

BATCH = 64
"""Batch size."""


def integrate(
    function: Callable[..., Tensor],
    inputs: tuple[Tensor, ...],
    baselines: tuple[Tensor, ...],
    min_change: float,
    progress: Progress = None,
) -> tuple[tuple[Tensor, ...], int, float]:
    """Integrated gradients ``(x_i - b_i) mean over a of df/dx_i(b + a (x - b))`` (Sundararajan et al., 2017).

    They sum to ``f(x) - f(b)`` on every segment of the path as on the whole. Segments with large errors are bisected
    until the sum of errors, and their root sum of squares, which cannot cancel, are below ``TOLERANCE`` of the change,
    or until another round would exceed ``MAX_POINTS`` gradients.

    Args:
        function: batches (B, ...) of the inputs to (B,).
        inputs, baselines: (1, ...) each.
        min_change: minimum reference for relative errors.
        progress: called with the part of ``MAX_POINTS`` that is done.

    Returns:
        Attributions (1, ...), number of gradients, and relative error of the sum.
    """
    method = _captum().IntegratedGradients(function)

    def point(position: Tensor) -> tuple[Tensor, ...]:
        return tuple(
            b + position.to(b.dtype).reshape(-1, *(1,) * (b.ndim - 1)) * (x - b)
            for x, b in zip(inputs, baselines, strict=True)
        )

    def attribute(edges: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """Attributions (P, ...) of segments from edges[:, 0] to edges[:, 1], and errors of their sums (P,)."""
        ends, starts = point(edges[:, 1]), point(edges[:, 0])
        attributions = method.attribute(ends, starts, n_steps=POINTS, method="gausslegendre")
        with torch.no_grad():
            change = (function(*ends) - function(*starts)).double()
        return attributions, sum(values.flatten(1).double().sum(1) for values in attributions) - change

    with torch.no_grad():
        change = max(abs(float(function(*inputs) - function(*baselines))), min_change)
    positions = torch.linspace(0.0, 1.0, SEGMENTS + 1, dtype=torch.float64)
    edges = torch.stack([positions[:-1], positions[1:]], dim=1)
    total = [torch.zeros_like(x) for x in inputs]
    final_errors, points = torch.zeros(0, dtype=torch.float64), 0
    while len(edges):
        segments = []
        for part in edges.split(BATCH // POINTS):
            segments.append(attribute(part))
            points += POINTS * len(part)
            if progress is not None:
                progress(points / MAX_POINTS)
        errors = torch.cat([error for _, error in segments])
        all_errors = torch.cat([final_errors, errors])
        gap = max(abs(float(all_errors.sum())), float(all_errors.norm())) / change
        limit = min(0.5 * TOLERANCE * change / len(all_errors) ** 0.5, float(errors.abs().median()))
        refine = errors.abs() > limit
        if gap < TOLERANCE or points + 2 * POINTS * int(refine.sum()) > MAX_POINTS:
            refine = torch.zeros_like(refine)
        final_errors = torch.cat([final_errors, errors[~refine]])
        for i, values in enumerate(total):
            values += torch.cat([attributions[i] for attributions, _ in segments])[~refine].sum(0)
        middle = edges[refine].mean(1, keepdim=True)
        edges = torch.cat([torch.cat([edges[refine, :1], middle], 1), torch.cat([middle, edges[refine, 1:]], 1)])
    return tuple(total), points, gap


def _captum() -> Any:
    """The module ``captum.attr``. Raises BadInput if captum is not installed."""
    try:
        from captum import attr  # slow to import
    except ImportError:
        raise BadInput("saliency needs the package captum: pip install 'beliefscope[attribution]'") from None
    return attr


@torch.no_grad()
def occlude(
    function: Callable[..., Tensor], inputs: tuple[Tensor, ...], baselines: tuple[Tensor, ...], window: int
) -> tuple[Tensor, ...]:
    """Occlusion: ``f(x)`` minus f with a square of ``window`` pixels, or one channel, at its baseline.

    Squares overlap by half; a pixel gets the mean of the squares that cover it (Zeiler and Fergus, 2014). For the
    arguments see ``integrate``. Returns (1, ...) each.
    """
    is_image = [values.ndim == 3 for values in inputs]
    attributions: tuple[Tensor, ...] = (
        _captum()
        .Occlusion(function)
        .attribute(
            inputs,
            sliding_window_shapes=tuple((window, window) if image else (1,) for image in is_image),
            strides=tuple(max(1, window // 2) if image else 1 for image in is_image),
            baselines=baselines,
            perturbations_per_eval=BATCH,
        )
    )
    return attributions

"""Oracle fusion weights, the best given the true state, and the best constant weights by phase."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.statistics.measures import Array

TIE = 1e-9
"""Weight of the distance to the effective weights relative to squared errors scaled to 1; breaks ties."""


def oracle_weights(errors: Array, near: Array) -> Array:
    """Convex weights of K estimates whose weighted mean is closest to the true state.

    ``min |sum_k w_k e_k|^2`` over ``w_k >= 0, sum w_k = 1``. The solution is exact: the minimum on each face of the
    simplex has a closed form, and the best feasible one is selected. Two scalar errors give
    ``w_1 = e_2 / (e_2 - e_1)``, clipped to 0..1. Ties are resolved in favour of weights close to ``near``.

    Args:
        errors: (..., d, K) errors of the K estimates in d components.
        near: (..., K).

    Returns:
        (..., K).
    """
    return simplex_minimum(np.swapaxes(errors, -1, -2) @ errors, near)


def simplex_minimum(gram: Array, near: Array) -> Array:
    """Minimum of ``w^T G w`` over ``w_k >= 0, sum w_k = 1`` for G (..., K, K); ties as in ``oracle_weights``."""
    count = gram.shape[-1]
    size = np.trace(gram, axis1=-2, axis2=-1)[..., None, None]
    gram = np.divide(gram, size, out=np.zeros_like(gram), where=size > 0)
    best, lowest = np.zeros_like(near), np.full(near.shape[:-1], np.inf)
    for members in (list(face) for size in range(count, 0, -1) for face in combinations(range(count), size)):
        inverse = np.linalg.inv(gram[..., members, :][..., members] + TIE * np.eye(len(members)))
        target, ones = TIE * (inverse @ near[..., members, None])[..., 0], inverse.sum(-1)
        multiplier = (1.0 - target.sum(-1, keepdims=True)) / ones.sum(-1, keepdims=True)
        weights = np.zeros_like(near)
        weights[..., members] = target + multiplier * ones
        cost = (weights[..., None, :] @ gram @ weights[..., None])[..., 0, 0]
        cost = cost + TIE * np.square(weights - near).sum(-1)
        better = (weights >= -1e-12).all(-1) & (cost < lowest)
        best = np.where(better[..., None], weights, best)
        lowest = np.where(better, cost, lowest)
    best = np.maximum(best, 0.0)
    return best / best.sum(-1, keepdims=True)


def unbiased_weights(gram: Array) -> Array:
    """Minimum of ``w^T G w`` over ``sum_k w_k = 1`` for G (..., K, K): ``G^-1 1 / (1^T G^-1 1)``, also negative.

    With the second moments of K errors as G, the best linear combination of K unbiased estimates. Two errors with RMSE
    i and h and correlation r leave ``(1 - r^2) i^2 h^2 / (i^2 + h^2 - 2 r i h)``, independent ones
    ``i^2 / (1 + (i/h)^2)``. Equal weights if G is zero.
    """
    count = gram.shape[-1]
    size = np.trace(gram, axis1=-2, axis2=-1)[..., None, None]
    scaled = np.divide(gram, size, out=np.zeros_like(gram), where=size > 0)
    weights = np.linalg.inv(scaled + TIE * np.eye(count)).sum(-1)
    return weights / weights.sum(-1, keepdims=True)


def squared_error(weights: Array, gram: Array) -> Array:
    """``w^T G w`` of weights (..., K) and second moments (..., K, K)."""
    return np.einsum("...k,...kl,...l->...", weights, gram, weights)


def constant_weights(
    errors: Sequence[Array], phases: Sequence[NDArray[np.int64]], near: Sequence[Array]
) -> list[Array]:
    """Best constant weights by phase, each trajectory's from all others (leave-one-out), by step.

    They are causal: a filter that recognises the phase could use them, which is impossible for the oracle's weights.

    Args:
        errors: by trajectory (T, W, d, K): errors of the K estimates in d components, for each of W weights.
        phases: by trajectory (T,): index of the phase.
        near: by trajectory (T, W, K): weights that resolve ties, and are used for phases without other trajectories.

    Returns:
        By trajectory (T, W, K).
    """
    count = 1 + max(int(phase.max()) for phase in phases)
    masks = [phase == np.arange(count)[:, None] for phase in phases]  # (P, T)
    grams = np.stack(
        [np.einsum("pt,twdk,twdl->pwkl", mask, e, e, optimize=True) for mask, e in zip(masks, errors, strict=True)]
    )
    sums = sum(np.einsum("pt,twk->pwk", mask, w) for mask, w in zip(masks, near, strict=True))
    steps = np.maximum(sum(mask.sum(1) for mask in masks), 1)
    others = grams.sum(0) - grams
    weights = simplex_minimum(others, np.broadcast_to(sums / steps[:, None, None], others.shape[:-1]))
    return [w[phase] for w, phase in zip(weights, phases, strict=True)]

"""Statistics of likelihood maps: peak, entropy, area, orientation, shape and divergence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.maps.likelihood_map import LikelihoodMap
from beliefscope.inspect.maps.shape import classify, fit_rings
from beliefscope.inspect.statistics.signals import Array
from beliefscope.inspect.traces.data import Trace


@dataclass(frozen=True)
class MapStatistics:
    """Statistics of the maps of B steps with L layers. p is the likelihood normalised to a density over the map.

    Units are those of a map over positions; of a curve, areas are lengths. Axis, elongation, shape and ring are of
    interest only if the map has two components of the same unit.

    Attributes:
        steps: (B,) steps of the trace.
        layers: L names.
        peak: (B, L, 2) m, offset of the maximum from the true position.
        mean: (B, L, 2) m, mean of p as an offset from the true position.
        log_peak: (B, L) log-likelihood of the maximum.
        truth: (B, L) log-likelihood at the true position relative to the maximum.
        entropy: (B, L) nats, ``-int p ln p``, p per m^2; independent of the number of cells. The maximum is the log of
            the square's area, of a uniform map.
        area50, area95: (B, L) m^2, area of the smallest region with that share of p.
        axis: (B, L) rad in -pi/2..pi/2 from the x axis: principal axis of p.
        elongation: (B, L) ratio of largest to smallest standard deviation of p; at 1 the axis is undefined.
        expected: (B,) rad, direction of the ridge that the task expects (``Task.ridge_direction``) in the true state;
            NaN for a task without one, and where the truth is unknown.
        deviation: (B, L) rad in 0..pi/2, angle between axis and expected direction; 45 deg on average for random axes.
        shape: (B, L) index in ``SHAPES``.
        ring_centre, ring_radius, ring_spread, ring_coverage: (B, L, 2) m, (B, L) m, (B, L), (B, L): circle fitted to
            the 50 % region (``shape.Rings``); of interest where the shape is a ring.
        divergence: (B, L, L) nats, ``KL(p_i || p_j)``.
        overlap: (B, L, L) ``int min(p_i, p_j)``, 0 to 1.
    """

    steps: NDArray[np.int64]
    layers: tuple[str, ...]
    peak: Array
    mean: Array
    log_peak: Array
    truth: Array
    entropy: Array
    area50: Array
    area95: Array
    axis: Array
    elongation: Array
    expected: Array
    deviation: Array
    shape: NDArray[np.int64]
    ring_centre: Array
    ring_radius: Array
    ring_spread: Array
    ring_coverage: Array
    divergence: Array
    overlap: Array


def measure_maps(maps: Sequence[LikelihoodMap], trace: Trace) -> MapStatistics:
    """Compute the statistics of maps of equal size."""
    log = np.stack([m.log_likelihood for m in maps]).astype(np.float64)
    x, y = (offsets.astype(np.float64) for offsets in (maps[0].offsets_x, maps[0].offsets_y))
    size, cell = len(x), float(np.prod([(q[-1] - q[0]) / (len(q) - 1) for q in (x, y) if len(q) > 1]))
    log_peak = log.max(axis=(2, 3))
    share = np.exp(log - log_peak[..., None, None])
    total = share.sum(axis=(2, 3), keepdims=True)
    share /= total
    log_share = log - log_peak[..., None, None] - np.log(total)
    flat, flat_log = share.reshape(*share.shape[:2], -1), log_share.reshape(*share.shape[:2], -1)
    # One cell, or the two or four around the true position for an even size.
    rows, columns = ([(len(q) - 1) // 2, len(q) // 2] for q in (y, x))
    at_truth = log[:, :, rows][..., columns].mean(axis=(2, 3))
    best = flat.argmax(axis=-1)
    mean, axis, elongation = _principal(share, x, y)
    expected = _expected(maps, trace) if maps[0].components == trace.task.map_indices else np.full(len(maps), np.nan)
    deviation = np.abs((axis - expected[:, None] + np.pi / 2.0) % np.pi - np.pi / 2.0)
    plogp = np.einsum("blc,blc->bl", flat, flat_log)
    ordered = -np.sort(-flat, axis=-1)
    area50, lowest = _area(ordered, 0.5)
    lowest = lowest[..., None, None]
    rings = fit_rings(share, share >= lowest, x, y)
    core = (share > lowest) | (log == log_peak[..., None, None])  # without a background of cells equal to the lowest
    return MapStatistics(
        steps=np.array([m.step for m in maps]),
        layers=maps[0].layers,
        peak=np.stack([x[best % size], y[best // size]], axis=-1),
        mean=mean,
        log_peak=log_peak,
        truth=at_truth - log_peak,
        entropy=-plogp + np.log(cell),
        area50=area50 * cell,
        area95=_area(ordered, 0.95)[0] * cell,
        axis=axis,
        elongation=elongation,
        expected=expected,
        deviation=deviation,
        shape=classify(area50, size * len(y), elongation, rings, log_peak - log.min(axis=(2, 3)), core),
        ring_centre=rings.centre,
        ring_radius=rings.radius,
        ring_spread=rings.spread,
        ring_coverage=rings.coverage,
        divergence=np.maximum(plogp[:, :, None] - np.einsum("blc,bmc->blm", flat, flat_log), 0.0),
        overlap=np.minimum(flat[:, :, None], flat[:, None]).sum(axis=-1),
    )


def _area(ordered: Array, mass: float) -> tuple[Array, Array]:
    """(B, L) number of cells, largest first, with that share of the total, and value of the last cell.

    The last cell counts in part.
    """
    cumulative = ordered.cumsum(axis=-1)
    complete = (cumulative < mass).sum(axis=-1, keepdims=True)
    last = np.take_along_axis(ordered, complete, axis=-1)
    before = np.take_along_axis(cumulative, complete, axis=-1) - last
    return np.asarray((complete + (mass - before) / last)[..., 0], dtype=np.float64), last[..., 0]


def _principal(share: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """(B, L, 2) mean, (B, L) principal axis and elongation of the covariance of normalised maps."""
    along_x, along_y = share.sum(axis=2), share.sum(axis=3)
    mean_x, mean_y = along_x @ x, along_y @ y
    xx, yy = along_x @ x**2 - mean_x**2, along_y @ y**2 - mean_y**2
    xy = (share @ x) @ y - mean_x * mean_y
    spread = np.hypot(0.5 * (xx - yy), xy)
    tiny = (x[1] - x[0]) ** 2 / 12.0  # variance within a cell; a map of one cell is round
    ratio = (0.5 * (xx + yy) + spread + tiny) / np.maximum(0.5 * (xx + yy) - spread + tiny, 1e-12)
    return np.stack([mean_x, mean_y], axis=-1), 0.5 * np.arctan2(2.0 * xy, xx - yy), np.sqrt(ratio)


def _expected(maps: Sequence[LikelihoodMap], trace: Trace) -> Array:
    direction = trace.task.ridge_direction
    if direction is None:
        return np.full(len(maps), np.nan)
    return np.asarray(direction(trace.episode.states[[m.step for m in maps]]), dtype=np.float64)


def has_layer_weights(trace: Trace) -> bool:
    """Whether the particle weights of the posterior of each layer are known (``layer_weights``)."""
    by_modality = trace.log_likelihood is not None and trace.prior_log_weights is not None
    return trace.log_weights is not None and (by_modality or not trace.modalities)


def layer_weights(trace: Trace, step: int) -> NDArray[np.float32]:
    """(L, M) particle weights of the posterior of each layer, which sum to 1; of the fused one only for K = 0."""
    assert trace.log_weights is not None
    log = trace.log_weights[step][None]
    if trace.modalities:
        assert trace.log_likelihood is not None
        assert trace.prior_log_weights is not None
        log = np.concatenate([trace.prior_log_weights[step] + trace.log_likelihood[step], log])
    return np.asarray(np.exp(log - np.logaddexp.reduce(log, axis=1, keepdims=True)), dtype=np.float32)


def particle_cloud(
    trace: Trace, step: int, components: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Components (M, 2) of the predicted particles, SI, and their weights (L, M) by layer (``layer_weights``).

    None for a filter without particles or without weights by layer.
    """
    if trace.particles is None or not has_layer_weights(trace):
        return None
    points = trace.task.near(trace.particles[step], trace.episode.states[step])[:, list(components)]
    points = np.pad(points, ((0, 0), (0, 2 - points.shape[1])))  # a curve has no second one
    return points, layer_weights(trace, step)

"""Shape of maps: circle fitted to the likely cells, and classes such as flat, round, ridge and ring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.statistics.signals import Array

SHAPES = ("flat", "round", "ridge", "ring", "cut by border")
"""Shapes of a map, in the order of ``classify``."""

ROUND = 1.3
"""Elongation below which the principal axis of a map is not meaningful."""

FLAT = 0.4
"""Part of the square that the 50 % region of a flat map covers at least; 0.5 if uniform."""

FLAT_RANGE = 2.0
"""nats; a map without ring and ridge whose logarithm varies by less is flat: a 95 % likelihood interval of one
component (1.92 nats) has all of the square."""

MAX_SPREAD, MIN_COVERAGE = 0.3, 0.6
"""Limits of a ring. A round peak has a spread of at least 0.35, that of a uniform disc; a straight ridge, or an arc of
less than half a circle, a coverage below 0.6."""

SECTORS = 16


@dataclass(frozen=True)
class Rings:
    """Circles fitted to the 50 % regions of B x L maps.

    Attributes:
        centre: (B, L, 2) SI, offset from the true position.
        radius: (B, L) SI, mean distance of the region from the centre, weighted by p.
        spread: (B, L) standard deviation of that distance relative to the radius; 0 for a thin ring.
        coverage: (B, L) part of the circle's angles that the region covers: exp of the entropy over sectors.
    """

    centre: Array
    radius: Array
    spread: Array
    coverage: Array


def fit_rings(share: Array, region: NDArray[np.bool_], x: Array, y: Array) -> Rings:
    """Weighted least-squares circles: minimum of ``E (|q|^2 - 2 a.q - c)^2`` over positions q, at ``|a|^2 + c = r^2``.

    The fit (Kasa, "A circle fitting procedure and its error analysis", 1976) is linear, so all maps are fitted at
    once. It is restricted to the 50 % region, since a low background would dominate the third moments.

    Args:
        share: (B, L, R, S) p per cell. region: same shape, cells of the 50 % region. x, y: (S,), (R,) offsets.
    """
    scale = float(x[-1] - x[0]) / 2.0
    inside = np.where(region, share, 0.0)
    inside /= inside.sum(axis=(2, 3), keepdims=True)
    powers_x, powers_y = (np.stack([(q / scale) ** k for k in range(4)], axis=1) for q in (x, y))
    moment = powers_y.T @ (inside @ powers_x)  # (B, L, 4, 4), [i, j] = E y^i x^j
    xx, yy, xy = moment[..., 0, 2], moment[..., 2, 0], moment[..., 1, 1]
    mx, my = moment[..., 0, 1], moment[..., 1, 0]
    within_cell = ((x[1] - x[0]) / scale) ** 2 / 12.0  # keeps the system regular for one cell
    rows = [[xx + within_cell, xy, mx], [xy, yy + within_cell, my], [mx, my, np.ones_like(mx)]]
    normal = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    target = np.stack([moment[..., 0, 3] + moment[..., 2, 1], moment[..., 3, 0] + moment[..., 1, 2], xx + yy], axis=-1)
    solution = np.linalg.solve(normal, target[..., None])[..., :2, 0]
    centre = np.asarray(0.5 * scale * solution, dtype=np.float64)
    sample, layer, iy, ix = np.nonzero(region)
    maps, count, mass = sample * share.shape[1] + layer, mx.size, inside[sample, layer, iy, ix]
    dx, dy = x[ix] - centre[sample, layer, 0], y[iy] - centre[sample, layer, 1]
    distance = np.hypot(dx, dy)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(maps, mass * values, count), dtype=np.float64).reshape(mx.shape)

    radius = mean(distance)
    spread = np.sqrt(np.maximum(mean(distance**2) - radius**2, 0.0))
    sector = np.floor((np.arctan2(dy, dx) / (2.0 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    by_sector = np.bincount(maps * SECTORS + sector, mass, count * SECTORS).reshape(*mx.shape, SECTORS)
    entropy = -(by_sector * np.log(np.where(by_sector > 0.0, by_sector, 1.0))).sum(axis=-1)
    return Rings(centre, radius, spread / np.maximum(radius, 1e-12), np.exp(entropy) / SECTORS)


def classify(
    area50: Array, square: float, elongation: Array, rings: Rings, log_range: Array, core: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """(B, L) index in ``SHAPES``.

    A map without another shape is round only if its 50 % region is complete: what the border cuts off is unknown.

    Args:
        area50: (B, L) area of the 50 % region, in the units of ``square``, the area of the map.
        log_range: (B, L) nats, difference between the largest and the smallest value of the map.
        core: (B, L, R, S) cells of the 50 % region, without those equal to its lowest value.
    """
    ring = (rings.spread <= MAX_SPREAD) & (rings.coverage >= MIN_COVERAGE)
    cut = core[..., [0, -1], :].any((2, 3)) | core[..., [0, -1]].any((2, 3))
    conditions = [area50 >= FLAT * square, ring, elongation >= ROUND, log_range < FLAT_RANGE, cut]
    shapes = [SHAPES.index(name) for name in ("flat", "ring", "ridge", "flat", "cut by border")]
    return np.select(conditions, shapes, SHAPES.index("round")).astype(np.int64)

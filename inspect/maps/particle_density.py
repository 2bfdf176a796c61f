"""Kernel density of weighted particles, evaluated on the grid of a map: the prior of a particle filter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.task import Task
from beliefscope.filters.covariance_floor import with_floor
from beliefscope.inspect.statistics.measures import Array, wrap_angles

MAX_KERNELS = 5000
"""Larger particle sets are thinned in proportion to their weights; bounds the time of a map."""

PAIRS_AT_ONCE = 2_000_000
"""Pairs of cell and kernel evaluated together; bounds memory."""


class ParticleDensity:
    """Gaussian kernels of covariance ``h^2 S`` at ``m + sqrt(1 - h^2) (x_i - m)``, with the particles' weights.

    m and S are mean and covariance of the particles, so the density has exactly these moments at any bandwidth (Liu
    and West, "Combined parameter and state estimation in simulation-based filtering", 2001). The bandwidth is
    Silverman's, ``h = (4 / ((n + 2) M_eff))^(1 / (n + 4))`` with ``M_eff = 1 / sum w_i^2``, at most 1; as M grows it
    tends to zero and the density to that of the particles' distribution.
    """

    def __init__(
        self,
        task: Task,
        states: NDArray[np.float32],
        log_weights: NDArray[np.float32],
        components: Sequence[int] | None = None,
    ) -> None:
        """states: (M, n) SI. log_weights: (M,), normalised. components: of the density, the others integrated out."""
        weights = np.exp(log_weights.astype(np.float64))
        weights /= weights.sum()
        self._components = list(range(states.shape[1]) if components is None else components)
        particles, n = states[:, self._components].astype(np.float64), len(self._components)
        mean = weights @ particles
        deviation = particles - mean
        covariance = with_floor((deviation * weights[:, None]).T @ deviation, particles.var(axis=0))
        effective = min(1.0 / np.square(weights).sum(), MAX_KERNELS)
        h = min(1.0, float((4.0 / ((n + 2.0) * effective)) ** (1.0 / (n + 4.0))))
        if len(weights) > MAX_KERNELS:
            quantiles = (np.arange(MAX_KERNELS) + 0.5) / MAX_KERNELS
            deviation = deviation[np.searchsorted(weights.cumsum(), quantiles).clip(max=len(weights) - 1)]
            weights = np.full(MAX_KERNELS, 1.0 / MAX_KERNELS)
        self._angles = [i for i, k in enumerate(self._components) if task.components[k].unit == "rad"]
        self._centres = mean + np.sqrt(1.0 - h**2) * deviation
        self._whiten = np.linalg.inv(np.linalg.cholesky(h**2 * covariance))
        constant = np.log(np.diagonal(self._whiten)).sum() - 0.5 * n * np.log(2.0 * np.pi)
        with np.errstate(divide="ignore"):
            self._log_weights = np.log(weights) + constant

    def log_density(self, middle: Array, along: tuple[int, int], x: Array, y: Array) -> Array:
        """(R, S) log density at the cells [iy, ix] of a grid.

        The exponent of a kernel is a term by column, a term by row, and their product, which all kernels share. If
        angles on an axis may differ by more than half a turn, the kernels have copies a turn away.

        Args:
            middle: (n,) SI, centre of the grid. along: state components of its axes. x, y: (S,) and (R,) SI, offsets of
                its columns and rows.
        """
        axes = [self._components.index(k) for k in along]
        along_x, along_y = (self._whiten[:, axis] for axis in axes)
        difference = wrap_angles(middle[self._components] - self._centres, self._angles)
        log_weights = self._log_weights
        for axis, offsets in dict(zip(axes, (x, y), strict=True)).items():
            if axis in self._angles and np.abs(difference[:, axis]).max() + np.abs(offsets).max() > np.pi:
                turn = 2.0 * np.pi * np.eye(len(self._components))[axis]
                difference = np.concatenate([difference - turn, difference, difference + turn])
                log_weights = np.tile(log_weights, 3)
        from_centre = difference @ self._whiten.T
        columns = log_weights - 0.5 * np.square(from_centre + along_x * x[:, None, None]).sum(-1)
        rows = -y[:, None] * (from_centre @ along_y) - 0.5 * (along_y @ along_y) * y[:, None] ** 2
        at_column, at_row = (torch.from_numpy(terms.astype(np.float32)) for terms in (columns, rows))
        size = max(1, PAIRS_AT_ONCE // columns.size)
        sums = [torch.logsumexp(at_column + part[:, None], dim=-1) for part in at_row.split(size)]
        both = (along_x @ along_y) * y[:, None] * x
        return np.asarray(torch.cat(sums).numpy() - both, dtype=np.float64)

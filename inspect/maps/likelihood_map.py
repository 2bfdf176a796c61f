"""Likelihood maps of one step: a grid of positions around the true one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


@dataclass(frozen=True)
class LikelihoodMap:
    """One map per modality and one fused map, over offsets from the true position.

    PF: log-likelihood of each measurement model, and of the fused mixture. EKF, UKF: log density of each unimodal
    posterior and of the fused posterior.

    Attributes:
        step: step of the trace.
        angle: fixed value of the state component that is not on the map (rad), NaN if there is none.
        layers: L names: the trace's modalities, then ``fused``.
        offsets_x, offsets_y: (S,) m, cell centres relative to ``centre``, increasing.
        centre: (2,) m, the true position, or the fused estimate where it is unknown.
        log_likelihood: (L, S, S) natural log, not normalised; [l, iy, ix] is at offsets_y[iy], offsets_x[ix].
    """

    step: int
    angle: float
    layers: tuple[str, ...]
    offsets_x: Array
    offsets_y: Array
    centre: Array
    log_likelihood: Array

    def normalised(self) -> NDArray[np.uint8]:
        """(L, S, S) uint8: likelihood relative to the maximum of its layer, times 255."""
        peak = self.log_likelihood.max(axis=(1, 2), keepdims=True)
        return np.rint(255.0 * np.exp(self.log_likelihood - peak)).astype(np.uint8)

    def peaks(self) -> Array:
        """(L, 2) m: offset (x, y) of each layer's maximum."""
        flat = self.log_likelihood.reshape(len(self.layers), -1).argmax(axis=1)
        iy, ix = np.unravel_index(flat, self.log_likelihood.shape[1:])
        return np.stack([self.offsets_x[ix], self.offsets_y[iy]], axis=1)

"""Likelihood maps: how likely each modality finds every position of the map square, at one step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


@dataclass(frozen=True)
class LikelihoodMap:
    """One map per modality and one fused, over offsets from the true position.

    Attributes:
        step: of the trace. angle: value of the component that is held fixed (rad), NaN where there is none.
        layers: names: the modalities, then ``fused``; L of them.
        offsets_x, offsets_y: (S,) m, cell centres, increasing, relative to ``centre``. centre: (2,) m, world: the truth.
        log_likelihood: (L, S, S) natural log, not normalised; [l, iy, ix] belongs to offsets_y[iy], offsets_x[ix].
    """

    step: int
    angle: float
    layers: tuple[str, ...]
    offsets_x: Array
    offsets_y: Array
    centre: Array
    log_likelihood: Array

    def normalised(self) -> NDArray[np.uint8]:
        """(L, S, S) uint8: likelihood over its own layer's maximum, times 255."""
        peak = self.log_likelihood.max(axis=(1, 2), keepdims=True)
        return np.rint(255.0 * np.exp(self.log_likelihood - peak)).astype(np.uint8)

"""Maps of one step: a grid of positions around the true one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

Quantity = Literal["likelihood", "posterior"]
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
"""What a map can contain; the first that a filter has is the default."""


@dataclass(frozen=True)
class LikelihoodMap:
    """One map per modality and one fused map, over offsets from the true position.

    Likelihood: of the observation given the state. EKF, UKF: ``N(z_k; x, R_k)`` of each virtual sensor; PF: each
    measurement model, up to a factor. Posterior: density of the state. EKF, UKF: posterior of the update with one
    modality, and the fused posterior; PF: prior of the particles (``maps.particle_density``) times likelihood.

    Attributes:
        step: step of the trace.
        angle: fixed value of the state component that is not on the map (rad), NaN if there is none.
        layers: L names: the trace's modalities, then ``fused``.
        offsets_x, offsets_y: (S,) m, cell centres relative to ``centre``, increasing.
        centre: (2,) m, the true position, or the fused estimate where it is unknown.
        log_likelihood: (L, S, S) natural log of the quantity, likelihoods not normalised; [l, iy, ix] is at
            offsets_y[iy], offsets_x[ix].
        quantity: of all layers.
        rule: how the fused layer results from the modalities.
    """

    step: int
    angle: float
    layers: tuple[str, ...]
    offsets_x: Array
    offsets_y: Array
    centre: Array
    log_likelihood: Array
    quantity: Quantity = "likelihood"
    rule: str = ""

    @property
    def title(self) -> str:
        """Quantity and fusion rule: ``Posterior. Fused: product of posteriors (unimodal)``."""
        return f"{self.quantity.capitalize()}. Fused: {self.rule}"

    def normalised(self) -> NDArray[np.uint8]:
        """(L, S, S) uint8: value relative to the maximum of its layer, times 255."""
        peak = self.log_likelihood.max(axis=(1, 2), keepdims=True)
        return np.rint(255.0 * np.exp(self.log_likelihood - peak)).astype(np.uint8)

    def peaks(self) -> Array:
        """(L, 2) m: offset (x, y) of each layer's maximum."""
        flat = self.log_likelihood.reshape(len(self.layers), -1).argmax(axis=1)
        iy, ix = np.unravel_index(flat, self.log_likelihood.shape[1:])
        return np.stack([self.offsets_x[ix], self.offsets_y[iy]], axis=1)

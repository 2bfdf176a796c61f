"""Maps of one step: a grid of one or two state components around the true state."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.notebook_html import html_paragraph
from beliefscope.inspect.maps.plane import Others

if TYPE_CHECKING:
    from beliefscope.inspect.displayed_figure import DisplayedFigure

Array = NDArray[np.float32]

Quantity = Literal["likelihood", "posterior"]
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
"""What a map can contain; the first that a filter has is the default."""

MapSteps = Sequence[int] | None
"""Steps of maps; None: all."""


@dataclass(frozen=True)
class MapOptions:
    """What a map shows, as for ``MapEngine.map``: quantity, axes and treatment of the other components."""

    angle: float | None = None
    quantity: Quantity = "likelihood"
    components: tuple[str, ...] = ()
    others: Others | None = None


@dataclass(frozen=True)
class LikelihoodMap:
    """One map per modality and one fused map, over offsets of one or two state components from the true state.

    Likelihood: of the observation given the state. EKF, UKF: ``N(z_k; x, R_k)`` of each virtual sensor; PF: each
    measurement model, up to a factor. Posterior: density of the state. EKF, UKF: posterior of the update with one
    modality, and the fused posterior; PF: prior of the particles (``maps.particle_density``) times likelihood.

    Attributes:
        step: step of the trace.
        angle: fixed value of the only state component that is not on the map (SI); NaN if there is none or there are
            several, or if it is integrated out.
        layers: L names: the trace's modalities, then ``fused``.
        offsets_x, offsets_y: (S,) and (R,) SI, cell centres relative to ``centre``, increasing. R is S, or 1 for a
            curve over one component, at offset 0.
        centre: (2,) or (1,) SI, the true values, or those of the fused estimate where they are unknown.
        log_likelihood: (L, R, S) natural log of the quantity, likelihoods not normalised; [l, iy, ix] is at
            offsets_y[iy], offsets_x[ix].
        quantity: of all layers.
        rule: how the fused layer results from the modalities.
        components: indices of the state components of the x and the y axis, or of a curve. others: treatment of
            the others; note: the same in words.
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
    components: tuple[int, ...] = (0, 1)
    others: Others = "fixed"
    note: str = ""

    def __repr__(self) -> str:
        """One line; the arrays have thousands of values."""
        cells = " x ".join(map(str, self.log_likelihood.shape[1:]))
        return f"<LikelihoodMap: {self.quantity} of {', '.join(self.layers)} at step {self.step}, {cells} cells>"

    @property
    def is_curve(self) -> bool:
        """Whether it shows one component."""
        return len(self.components) == 1

    @property
    def title(self) -> str:
        """Quantity and fusion rule: ``Posterior. Fused: product of posteriors (unimodal)``."""
        return f"{self.quantity.capitalize()}{self.note and f', {self.note}'}. Fused: {self.rule}"

    def _repr_html_(self) -> str:
        """Title, and an image of all layers, in a notebook."""
        source = base64.b64encode(self.plot()._repr_png_()).decode()
        return html_paragraph(f"Step {self.step}. {self.title}", strong=True) + (
            f'<img src="data:image/png;base64,{source}">'
        )

    def plot(self) -> DisplayedFigure:
        """The layers side by side, relative to their maximum, over offsets from the centre (SI)."""
        from beliefscope.inspect.displayed_figure import DisplayedFigure  # slow to import

        count = len(self.layers)
        figure = DisplayedFigure(figsize=(2.1 * count, 1.4 if self.is_curve else 2.3), layout="constrained")
        for axes, name, values in zip(
            figure.subplots(1, count, squeeze=False)[0], self.layers, self.normalised(), strict=True
        ):
            if self.is_curve:
                axes.plot(self.offsets_x, values[0] / 255.0)
            else:
                x, y = (
                    q[0] - 0.5 * (q[1] - q[0]) for q in (self.offsets_x, self.offsets_y)
                )  # edges of the first cells
                axes.imshow(values, extent=(x, -x, y, -y), origin="lower", cmap="viridis")
                axes.plot(0, 0, "+", color="white")
            axes.set_title(name, fontsize=9)
            axes.tick_params(labelsize=7)
        return figure

    def normalised(self) -> NDArray[np.uint8]:
        """(L, R, S) uint8: value relative to the maximum of its layer, times 255."""
        peak = self.log_likelihood.max(axis=(1, 2), keepdims=True)
        return np.rint(255.0 * np.exp(self.log_likelihood - peak)).astype(np.uint8)

    def peaks(self) -> Array:
        """(L, 2) SI: offset (x, y) of each layer's maximum."""
        flat = self.log_likelihood.reshape(len(self.layers), -1).argmax(axis=1)
        iy, ix = np.unravel_index(flat, self.log_likelihood.shape[1:])
        return np.stack([self.offsets_x[ix], self.offsets_y[iy]], axis=1)

"""Colours of page, recordings and figures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

COLOURS: dict[str, str] = {
    "truth": "#009E73",
    "image": "#56B4E9",
    "haptics": "#E69F00",
    "fused": "#D55E00",
    "contact": "#CC79A7",
}
"""Okabe and Ito's palette, distinguishable with colour vision deficiency. Each colour has one meaning."""

SPARE_COLOURS: tuple[str, ...] = (
    "#F0E442",
    "#999999",
    "#882255",
    "#44AA99",
    "#332288",
    "#8C6D31",
    "#A6D854",
    "#0072B2",
)
"""Colours of other modalities, in the order of the trace's modalities, the one most like those above last; with dashes,
since eight colours are too many for some colour vision deficiencies."""


def colour(source: str, modalities: Sequence[str]) -> str:
    """``#RRGGBB`` of ``truth``, ``fused``, ``contact`` or a modality.

    Without a modality ``image``, the first one with another name has its colour.
    """
    if source in COLOURS:
        return COLOURS[source]
    unnamed = [modality for modality in modalities if modality not in COLOURS]
    spare = SPARE_COLOURS if "image" in modalities else (COLOURS["image"], *SPARE_COLOURS)
    return spare[unnamed.index(source) % len(spare)]


@cache
def colour_table(name: str) -> NDArray[np.uint8]:
    """(256, 3) RGB values of a matplotlib colour map."""
    from matplotlib import colormaps

    colours = np.asarray(colormaps[name](np.linspace(0.0, 1.0, 256)))
    return np.rint(255.0 * colours[:, :3]).astype(np.uint8)

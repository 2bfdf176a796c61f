"""The product's colours: one meaning each, in the page, recordings and figures."""

from __future__ import annotations

from collections.abc import Sequence

COLOURS: dict[str, str] = {
    "truth": "#009E73",
    "image": "#56B4E9",
    "haptics": "#E69F00",
    "fused": "#D55E00",
    "contact": "#CC79A7",
}
"""Okabe and Ito's colours, which people with any colour vision tell apart. One meaning each, all over the product."""

SPARE_COLOURS: tuple[str, ...] = ("#0072B2", "#F0E442", "#999999")
"""For modalities that ``COLOURS`` does not name, in the order of the trace's modalities."""


def colour(source: str, modalities: Sequence[str]) -> str:
    """``#RRGGBB`` of ``truth``, ``fused``, ``contact`` or a modality."""
    if source in COLOURS:
        return COLOURS[source]
    unnamed = [modality for modality in modalities if modality not in COLOURS]
    return SPARE_COLOURS[unnamed.index(source) % len(SPARE_COLOURS)]

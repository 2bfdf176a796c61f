"""Figures that display themselves in notebooks."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

RESOLUTION = 100  # dots per inch


class DisplayedFigure(Figure):
    """A figure that notebooks display without pyplot and its magic command."""

    def _repr_png_(self) -> bytes:
        png = io.BytesIO()
        self.savefig(png, format="png", dpi=RESOLUTION)
        return png.getvalue()

"""Bands behind charts: every step that has what they stand for, from half a step before to half a step after it."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from beliefscope.inspect.diagnostics.base import Picture, Plot
from beliefscope.inspect.diagnostics.plotting import draw_bands, png_of
from beliefscope.inspect.statistics.measures import stretches


@pytest.mark.parametrize(
    ("mask", "spans"),
    [("", []), ("...", []), ("#", [(0, 1)]), (".#.##", [(1, 2), (3, 5)]), ("##.#", [(0, 2), (3, 4)])],
)
def test_stretches(mask: str, spans: list[tuple[int, int]]) -> None:
    found = stretches(np.array([c == "#" for c in mask], dtype=bool))
    assert [tuple(span) for span in found.tolist()] == spans


def test_a_band_covers_its_steps_whole_lone_ones_and_those_at_the_ends_too() -> None:
    mask = np.random.default_rng(0).random(60) < 0.4
    mask[[0, 59, 7]] = True
    mask[[6, 8]] = False  # step 7 is alone
    axes = Figure().add_subplot()
    draw_bands(axes, {"contact": mask, "blackout": np.zeros(60, dtype=bool)})
    (drawn,) = axes.collections  # nothing for a kind that no step has
    spans = [tuple(path.get_extents().intervalx) for path in drawn.get_paths()]
    for x in np.arange(-0.45, 59.5, 0.1):
        step = int(np.rint(x))
        assert any(low <= x <= high for low, high in spans) == mask[step], (x, step)
    assert sum(high - low for low, high in spans) == pytest.approx(mask.sum())


def test_plots_and_pictures_by_themselves() -> None:
    rng = np.random.default_rng(0)
    for panel in (Plot("title", "x", "y", ()), Picture("title", rng.normal(size=(4, 4)), "1")):
        assert png_of(panel).startswith(b"\x89PNG")

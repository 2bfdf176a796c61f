"""Drawing of bands and panels."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from beliefscope.inspect.diagnostics.plotting import StepAxis, draw_bands, draw_figure, panel_png
from beliefscope.inspect.diagnostics.views import Curve, ImagePanel, Plot, Views
from beliefscope.inspect.statistics.measures import intervals


@pytest.mark.parametrize(
    ("mask", "spans"),
    [("", []), ("...", []), ("#", [(0, 1)]), (".#.##", [(1, 2), (3, 5)]), ("##.#", [(0, 2), (3, 4)])],
)
def test_intervals(mask: str, spans: list[tuple[int, int]]) -> None:
    result = intervals(np.array([c == "#" for c in mask], dtype=bool))
    assert [tuple(span) for span in result.tolist()] == spans


def test_bands_cover_complete_steps() -> None:
    mask = np.random.default_rng(0).random(60) < 0.4
    mask[[0, 59, 7]] = True
    mask[[6, 8]] = False  # step 7 is isolated
    axes = Figure().add_subplot()
    draw_bands(axes, {"contact": mask, "blackout": np.zeros(60, dtype=bool)}, StepAxis.from_times(60, None))
    (collection,) = axes.collections  # no band for a phase without steps
    spans = [tuple(path.get_extents().intervalx) for path in collection.get_paths()]
    for x in np.arange(-0.45, 59.5, 0.1):
        step = int(np.rint(x))
        assert any(low <= x <= high for low, high in spans) == mask[step], (x, step)
    assert sum(high - low for low, high in spans) == pytest.approx(mask.sum())


def test_bands_over_irregular_times_end_in_the_middle_between_steps() -> None:
    axes = Figure().add_subplot()
    axis = StepAxis.from_times(4, np.array([0.0, 1.0, 11.0, 11.5]))
    draw_bands(axes, {"contact": np.array([False, True, True, False])}, axis)
    (band,) = axes.collections[0].get_paths()
    assert tuple(band.get_extents().intervalx) == (0.5, 11.25)
    assert (axis.edges[0], axis.edges[-1], axis.label) == (-0.5, 11.75, "time (s)")
    single = StepAxis.from_times(1, np.array([2.0]))
    assert single.edges.tolist() == [1.5, 2.5]


class Named(Views):
    """One chart with curves of these names, all a ramp."""

    verdict = "A verdict."

    def __init__(self, chart: str, names: list[str]) -> None:
        self.chart, self.names = chart, names

    def curves(self) -> list[Curve]:
        return [Curve(name, np.arange(50.0), self.chart) for name in self.names]


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("title", "names", "columns"),
    [
        ("Error", ["fused", "image"], 2),
        ("Innovation in predicted standard deviations", [f"sensor_{i} innovation" for i in range(6)], 3),
        ("Weight of x", [f"sensor_{i} {kind} weight of angular velocity" for i in range(6) for kind in "ab"], 2),
        ("Weight of x", ["a name that is much longer than the figure is wide, " * 3, "b"], 1),
    ],
)
def test_legends_of_any_size_leave_title_and_chart_room(title: str, names: list[str], columns: int) -> None:
    figure = draw_figure(Named(title, names))
    figure.canvas.draw()
    (axes,) = figure.axes
    box, legend = axes.get_window_extent(), axes.get_legend()
    head = axes._left_title.get_window_extent()  # type: ignore[attr-defined]
    entries = legend.get_window_extent()
    assert legend._ncols == columns
    assert not head.overlaps(entries)
    assert min(head.y0, entries.y0) > box.y1 - 0.04 * box.height  # the padding of the legend
    assert box.height > 60.0
    if columns > 1:
        assert box.width > 0.85 * figure.bbox.width
        assert entries.x1 < figure.bbox.x1


def test_plots_and_pictures_by_themselves() -> None:
    rng = np.random.default_rng(0)
    for panel in (Plot("title", "x", "y", ()), ImagePanel("title", rng.normal(size=(4, 4)), "1")):
        assert panel_png(panel).startswith(b"\x89PNG")

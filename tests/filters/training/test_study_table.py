"""Rows, Markdown and figure of a study, from given numbers."""

from __future__ import annotations

from pathlib import Path

import pytest

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.catalog import filters_of
from beliefscope.filters.training.plan import BLACKOUTS
from beliefscope.filters.training.study import Cell
from beliefscope.filters.training.study_table import TRIVIAL, Row, rows_of, to_markdown
from beliefscope.recordings.study_figures import bar_styles, results


def test_figure_has_bars_error_bars_and_missing_filters() -> None:
    def row(name: str, blackout: float | None, value: float | None, spread: float | None = None) -> Row:
        mean, spreads = ({}, {}) if value is None else ({"position_cm": value}, {"position_cm": spread})
        return Row("push", name, blackout, 0 if value is None else 3, 3, 0, mean, spreads)

    rows = [row("crossmodal-ekf", b, 2.0 + b, 0.25) for b in BLACKOUTS]
    rows += [row("lstm", b, None) for b in BLACKOUTS] + [row("image-pf", b, 90.0, 1.0) for b in BLACKOUTS]
    (axis,) = results([*rows, row(TRIVIAL, None, 10.0)]).axes
    heights = [patch.get_height() for patch in axis.patches]
    assert heights == [2.0, 2.4, 2.8, 90.0, 90.0, 90.0]
    assert len(axis.containers) == 12  # a bar and its error bar each
    assert [text.get_text() for text in axis.texts] == ["90"] * 3
    assert axis.get_ylim()[1] == pytest.approx(1.06 * 20.0)
    dashed = [line for line in axis.lines if line.get_linestyle() == "--"]
    assert [line.get_ydata()[0] for line in dashed] == [10.0]
    assert sum(line.get_marker() == "x" for line in axis.lines) == 3
    # Far above all bars, the trivial predictor is only in the title.
    (axis,) = results([*rows[:3], row(TRIVIAL, None, 10.0)]).axes
    assert axis.get_ylim()[1] == pytest.approx(1.06 * 3.05)
    assert axis.get_title(loc="right") == f"{TRIVIAL}: 10.0 cm"
    assert not [line for line in axis.lines if line.get_linestyle() == "--"]


def test_bar_styles_of_filters_differ() -> None:
    names = list(filters_of(find_task("door")))
    styles = bar_styles(names).values()
    assert len({(style["facecolor"], style["hatch"]) for style in styles}) == len(styles) == len(names)


def test_updates_and_standalone_filters_have_columns_of_their_own() -> None:
    """The haptics-only update is near the fused estimate, the standalone filter is not."""
    errors = {"fused": 0.5, "update": 0.6, "image": 0.7, "haptics": 2.0}
    rmse = {name: {"hinge_x_cm": value, "position_cm": value} for name, value in errors.items()}
    consistency = {"nll": None, "nees": None, "coverage95": None}
    by_name = {
        "fused": {"rmse": rmse["fused"], "updates": {m: {"rmse": rmse["update"]} for m in ("image", "haptics")}},
        **{name: {"rmse": rmse[name]} for name in ("image", "haptics")},
    }
    by_name["fused"] |= consistency
    cell = Cell("door", "crossmodal-ekf", 0, "smoke", "door", Path("door.h5"), "")
    finished = {"seed": 0, "seconds": 1.0, "trivial": rmse["fused"], "metrics": {f"{b:g}": by_name for b in BLACKOUTS}}
    rows = rows_of({cell: finished})
    assert rows[0].updates["haptics"]["position_cm"] == 0.6
    assert rows[0].standalone["haptics"]["position_cm"] == 2.0
    table = to_markdown(rows)
    head = "| fused | image-only update | image standalone | haptics-only update | haptics standalone |"
    assert head in table
    assert "| crossmodal-ekf | 0% | 0.50 | 0.60 | 0.70 | 0.60 | 2.00 |" in table
    del by_name["fused"]["updates"]  # of earlier versions
    assert "| crossmodal-ekf | 0% | 0.50 |  | 0.70 |  | 2.00 |" in to_markdown(rows_of({cell: finished}))

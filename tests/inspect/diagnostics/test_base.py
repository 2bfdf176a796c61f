"""Interface of diagnostics: JSON, views, figures and refusals."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.diagnostics.views import TABLE_WIDTH, as_json, format_table
from beliefscope.inspect.statistics.measures import blackout
from beliefscope.inspect.trace import Trace

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant

pytestmark = pytest.mark.slow

EXTERNAL = ("innovations", "ensemble")
"""Diagnostics of external filters only, which ``test_estimator_kinds`` tests."""

OF_TRACES = [entry for entry in DIAGNOSTICS.values() if entry.needs == "trace" and entry.name not in EXTERNAL]


def estimates_only(steps: int = 60) -> Trace:
    """A trace like an LSTM's: estimates only."""
    base = plant.real("crossmodal-ekf", steps)
    others = ("weights", "effective_weights", "predicted_mean", "predicted_covariance")
    none: dict[str, Any] = dict.fromkeys((*others, "observation_mean", "observation_covariance"))
    return replace(
        base,
        kind="lstm",
        filter="lstm",
        modalities=(),
        estimate_covariance=np.full_like(base.estimate_covariance, np.nan),
        modality_mean=base.modality_mean[:, :0],
        modality_covariance=base.modality_covariance[:, :0],
        **none,
    )


PAIRS = [
    (entry, name)
    for entry in OF_TRACES
    for name in ("crossmodal-pf", "crossmodal-ekf")
    if (entry.name, name) != ("particles", "crossmodal-ekf")
]


@pytest.fixture(scope="module", params=PAIRS, ids=lambda pair: f"{pair[0].name}-{pair[1]}")
def results(request: pytest.FixtureRequest) -> tuple[Diagnostic, Diagnostic, Trace]:
    """Results of one trace and of six."""
    entry, name = request.param
    trace = plant.real(name)
    return entry([trace]), entry([trace] * 6), trace


def test_json_is_complete_without_nan(results: tuple[Diagnostic, Diagnostic, Trace]) -> None:
    for result in results[:2]:
        numbers = json.loads(json.dumps(result.to_dict(), allow_nan=False))
        assert numbers["verdict"] == result.verdict
        assert numbers["filter"] == results[2].filter
        views = json.loads(json.dumps(result.views(), allow_nan=False))
        assert [table["title"] for table in views["tables"]] == [table.title for table in result.tables()]


def test_non_finite_numbers_become_none() -> None:
    numbers = DIAGNOSTICS["consistency"]([plant.real("crossmodal-pf")]).to_dict()
    assert numbers["by_layer"][0]["nis"] is None  # not a Kalman filter
    values = {"a": np.array([1.0, np.nan]), "b": (np.float32("inf"), np.int64(3)), "c": np.array([True])}
    assert as_json(values) == {"a": [1.0, None], "b": [None, 3], "c": [True]}


def test_bands_of_map_statistics_include_warm_up_steps() -> None:
    trace, checkpoint = plant.real("crossmodal-ekf"), load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    assert trace.episode.contact[:30].any()
    bands = DIAGNOSTICS["maps"]([trace], checkpoint, size=5).bands()
    np.testing.assert_array_equal(bands["contact"], trace.episode.contact)
    np.testing.assert_array_equal(bands["blackout"], blackout(trace))


def test_views_match_the_trace(results: tuple[Diagnostic, Diagnostic, Trace]) -> None:
    single, several, trace = results
    assert single.verdict[0].isupper()
    assert single.verdict.endswith(".")
    assert {curve.values.shape for curve in single.curves()} == {(len(trace),)}
    bands = single.bands()
    assert bands.keys() <= {"contact", "blackout", "outage"}
    np.testing.assert_array_equal(bands.get("contact", trace.episode.contact), trace.episode.contact)
    assert not several.curves()
    assert not several.bands()
    for result in (single, several):
        assert result.tables()
        for table in result.tables():
            assert {len(row) for row in table.rows} == {len(table.columns)}, table.title


@pytest.mark.first(2)
def test_figures_are_written(results: tuple[Diagnostic, Diagnostic, Trace], tmp_path: Path) -> None:
    figure = results[0].plot()
    curves = results[0].curves()
    assert sum(len(axes.lines) for axes in figure.axes) >= len(curves)
    write_figure(figure, tmp_path / "one.svg")
    write_figure(results[1].plot(), tmp_path / "several.png")
    text = (tmp_path / "one.svg").read_text(encoding="utf-8")
    assert "</svg>" in text
    assert curves[0].name in text
    assert (tmp_path / "several.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(BadInput, match=r"figure format 'bmp' does not exist\. Available: svg, pdf, png"):
        write_figure(figure, tmp_path / "one.bmp")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.svg", "several.png"]


@pytest.mark.parametrize("entry", OF_TRACES, ids=lambda entry: entry.name)
def test_no_traces_and_traces_of_two_filters_are_refused(entry: Entry) -> None:
    with pytest.raises(BadInput, match=f"{entry.name} needs at least one trace"):
        entry([])
    single = plant.real("crossmodal-pf")
    with pytest.raises(BadInput, match=f"traces of two checkpoints, {single.checkpoint_hash[:12]} and ffff"):
        entry([single, replace(single, checkpoint_hash="f" * 64)])


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("weights", "filter lstm has no fusion weights: one network processes all modalities"),
        ("consistency", "filter lstm has no covariance to compare its errors with"),
        ("particles", "filter lstm has no particles"),
    ],
)
def test_diagnostics_that_do_not_apply_to_an_lstm(name: str, why: str) -> None:
    assert DIAGNOSTICS[name].refusal(estimates_only(), None) == why
    with pytest.raises(BadInput, match=why):
        DIAGNOSTICS[name]([estimates_only()])


def test_missing_checkpoint_is_refused() -> None:
    why = DIAGNOSTICS["maps"].refusal(plant.real("crossmodal-pf"), None)
    assert (
        why == "diagnostic maps needs the filter, not only its trace: give its checkpoint, or --filter FILE.py:FUNCTION"
    )


def test_unknown_numbers_of_a_table_are_dashes() -> None:
    rows = [(1.0, 2), (None, None), (float("nan"), 12)]
    assert format_table("Title", ("a", "b"), rows).splitlines() == ["Title", "  a   b", "  1   2", "  -   -", "  -  12"]


def test_wide_tables_continue_below_with_the_names_of_the_rows() -> None:
    columns = ("group", *(f"column {i:02} of this table" for i in range(14)))
    values = [float(i) for i in range(14)]
    lines = format_table("Title", columns, [("all", *values), ("fix", *values)]).splitlines()
    assert max(map(len, lines)) <= TABLE_WIDTH
    assert [line.split()[0] if line else "" for line in lines] == ["Title", *2 * ["group", "all", "fix", ""]][:-1]
    assert " ".join(lines).count("column 13 of this table") == 1

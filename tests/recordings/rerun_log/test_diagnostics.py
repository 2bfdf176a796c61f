"""Diagnostics in recordings: entities equal the diagnostics, and an import ignores them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.catalog import DIAGNOSTICS, quick
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.diagnostics.views import Curve, ImagePanel, Plot, Table
from beliefscope.inspect.trace import Trace, trace
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.rerun_log.diagnostics import diagnostic_tab, log_diagnostic, slug
from beliefscope.recordings.schema import SCHEMA, STEP, TIME
from beliefscope.recordings.write import write_recording

pytestmark = pytest.mark.slow

Chunks = dict[str, dict[str, list[Any]]]


def run_and_diagnostics(name: str) -> tuple[Trace, Mapping[str, Diagnostic]]:
    checkpoint = load_checkpoint(pretrained_path("door", name))
    with open_dataset(sample_path("door")) as data:
        run = trace(checkpoint, data[9], 9, particles=50, faults=Faults.parse("blackout=0.3"))
    return run, quick(run, checkpoint)


@pytest.fixture(scope="module", params=["crossmodal-pf", "crossmodal-ekf", "image-ekf"])
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A run, its diagnostics and its recording: with particles, with innovations, and unimodal."""
    run, diagnostics = run_and_diagnostics(request.param)
    path = write_recording(run, tmp_path_factory.mktemp("rrd") / "run.rrd", diagnostics=diagnostics)
    return run, diagnostics, path


def stored(path: Path) -> Chunks:
    """Path under ``diagnostics/`` -> component or timeline -> rows of all chunks in order."""
    rows: Chunks = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(path).stream().filter(content="/diagnostics/**"):
        batch = chunk.to_record_batch()
        for column in batch.schema.names:
            rows[chunk.entity_path.removeprefix("/diagnostics/")][column] += batch.column(column).to_pylist()
    return rows


def scalars(rows: Mapping[str, list[Any]]) -> NDArray[np.float64]:
    return np.array(rows["Scalars:scalars"], dtype=np.float64)


@pytest.mark.first(1)
def test_curves_equal_the_diagnostic(recorded: Any) -> None:
    run, diagnostics, path = recorded
    rows = stored(path)
    expected = {
        f"{name}/curves/{slug(curve.chart)}/{slug(curve.name)}": curve
        for name, diagnostic in diagnostics.items()
        for curve in diagnostic.curves()
    }
    assert len(expected) == sum(len(d.curves()) for d in diagnostics.values()) > 0, "paths are not unique"
    assert {name for name in rows if "/curves/" in name} == expected.keys()
    for name, curve in expected.items():
        assert rows[name][STEP] == list(range(len(run)))
        np.testing.assert_array_equal(scalars(rows[name])[:, 0], curve.values)  # stored as float64
        (names,) = filter(None, rows[name]["SeriesLines:names"])
        assert names == [curve.name]


def test_bounds_and_bands_equal_the_diagnostic(recorded: Any) -> None:
    run, diagnostics, path = recorded
    rows = stored(path)
    for name, diagnostic in diagnostics.items():
        for curve in diagnostic.curves():
            bounds = rows.get(f"{name}/bounds/{slug(curve.chart)}")
            if curve.bounds is not None:
                assert bounds is not None
                assert bounds[STEP] == [0, len(run) - 1]
                assert set(curve.bounds) <= set(scalars(bounds)[0]) == set(scalars(bounds)[1])
        for kind, mask in diagnostic.bands().items():
            if not mask.any():
                assert f"{name}/bands/{kind}" not in rows
                continue
            changes = rows[f"{name}/bands/{kind}"]
            states = [state[0] == kind for state in changes["StateChange:state"] if state]
            last = np.searchsorted(changes[STEP], np.arange(len(run)), side="right") - 1
            np.testing.assert_array_equal(np.array(states)[last], mask)


def test_text_contains_the_verdict_and_every_table(recorded: Any) -> None:
    _, diagnostics, path = recorded
    rows = stored(path)
    assert {name.split("/")[0] for name in rows} - {"effective_sample_size"} == set(diagnostics)
    for name, diagnostic in diagnostics.items():
        ((text,),) = rows[f"{name}/about"]["TextDocument:text"]
        assert text.startswith(
            f"# {DIAGNOSTICS[name].title}\n\n*{DIAGNOSTICS[name].question}*\n\n{diagnostic.verdict}\n"
        )
        for curve in diagnostic.curves():
            assert f"| {curve.chart} | {curve.name} | {curve.unit} |" in text
        for table in diagnostic.tables():
            body = text.split(f"## {table.title}\n\n")[1].split("\n\n")[0].strip().splitlines()
            assert len(body) == 2 + len(table.rows)
            assert {len(re.split(r"(?<!\\)\|", line)) for line in body} == {2 + len(table.columns)}


def test_paths_match_the_schema(recorded: Any) -> None:
    _, _, path = recorded
    templates = {
        re.compile(re.sub(r"\\{\w+\\}", r"\\w+", re.escape(entity.path))): entity
        for entity in SCHEMA
        if entity.path.startswith("diagnostics/")
    }
    for name, rows in stored(path).items():
        (entity,) = (entity for template, entity in templates.items() if template.fullmatch(f"diagnostics/{name}"))
        assert any(column.startswith(f"{entity.archetype}:") for column in rows), name
        assert entity.static or {STEP, TIME} <= rows.keys(), name


def test_import_ignores_diagnostics(recorded: Any, assert_same: Callable[[Trace, Trace], None]) -> None:
    run, _, path = recorded
    assert_same(run, read_recording(path))


def test_each_has_a_tab_and_the_file_is_valid(recorded: Any, tmp_path: Path) -> None:
    _, diagnostics, path = recorded
    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    text = "".join(str(chunk.to_record_batch().to_pydict()) for chunk in reader.stream(store=layout))
    for name, diagnostic in diagnostics.items():
        assert f"'{DIAGNOSTICS[name].title}'" in text
        assert all(f"'diagnostics/{name}/curves/{slug(curve.chart)}'" in text for curve in diagnostic.curves())
    rerun = shutil.which("rerun", path=os.path.dirname(sys.executable))
    if rerun is not None:
        home = {"HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
        subprocess.run([rerun, "rrd", "verify", path], check=True, capture_output=True, env=os.environ | home)


class CustomDiagnostic(Diagnostic):
    """Two steps of every kind of content, with special characters in names."""

    verdict = "Fine."

    def tables(self) -> list[Table]:
        return [Table("T", ("a|b", "c"), (("x|y", None), ("z", 0.12345)))]

    def curves(self) -> list[Curve]:
        return [
            Curve("KL (image || haptics)", np.array([1.0, np.nan]), "Ähnlich, in °", "nats", "image", (0.0, np.inf))
        ]

    def bands(self) -> dict[str, NDArray[np.bool_]]:
        return {"any kind": np.array([True, True])}

    def plots(self) -> list[Plot]:
        return [Plot("Plot / 1", "x", "y", ())]

    def images(self) -> list[ImagePanel]:
        return [ImagePanel("An image", np.eye(3))]


def test_log_to_a_custom_stream(new_trace: Callable[..., Trace], tmp_path: Path) -> None:
    run = new_trace("ekf", steps=2)
    with rr.RecordingStream("notebook") as stream:
        stream.save(tmp_path / "own.rrd")
        log_diagnostic(stream, CustomDiagnostic(), "my own", run)
    assert diagnostic_tab(CustomDiagnostic(), "my own").name == "my own"
    rows = stored(tmp_path / "own.rrd")
    assert set(rows) == {
        "my_own/about",
        "my_own/curves/ähnlich_in/kl_image_haptics",
        "my_own/bounds/ähnlich_in",
        "my_own/bands/any_kind",
        "my_own/plots/plot_1",
        "my_own/images/an_image",
    }
    assert scalars(rows["my_own/bounds/ähnlich_in"]).tolist() == [[0.0], [0.0]]  # infinite bounds are omitted
    assert np.isnan(scalars(rows["my_own/curves/ähnlich_in/kl_image_haptics"])[1, 0])
    ((text,),) = rows["my_own/about"]["TextDocument:text"]
    assert text.startswith("# my own\n\nFine.\n")
    assert r"| x\|y | - |" in text
    with pytest.raises(BadInput, match=r"my own has curves of 2 steps, but the trace has 40 steps"):
        log_diagnostic(stream, CustomDiagnostic(), "my own", new_trace("ekf"))


def test_default_is_the_current_stream(new_trace: Callable[..., Trace], tmp_path: Path) -> None:
    with rr.RecordingStream("notebook") as stream:
        stream.save(tmp_path / "own.rrd")
        log_diagnostic(None, CustomDiagnostic(), "own", new_trace("ekf", steps=2))
    assert "own/about" in stored(tmp_path / "own.rrd")

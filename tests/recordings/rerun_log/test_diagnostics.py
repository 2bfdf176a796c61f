"""Diagnostics in recordings: what Rerun reads back is what they show, and an import passes over them."""

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
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.catalog import DIAGNOSTICS, quick
from beliefscope.inspect.diagnostics.base import Curve, Diagnostic, Picture, Plot, Table
from beliefscope.inspect.trace import Trace, trace
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.rerun_log.diagnostics import diagnostic_tab, log_diagnostic, slug
from beliefscope.recordings.schema import SCHEMA, STEP, TIME
from beliefscope.recordings.write import write_recording

Chunks = dict[str, dict[str, list[Any]]]


def made(name: str) -> tuple[Trace, Mapping[str, Diagnostic]]:
    checkpoint = load_checkpoint(shipped("door", name))
    with open_dataset(sample_path("door")) as data:
        run = trace(checkpoint, data[9], 9, particles=50, faults=Faults.parse("blackout=0.3"))
    return run, quick(run, checkpoint)


@pytest.fixture(scope="module", params=["crossmodal-pf", "crossmodal-ekf", "image-ekf"])
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A run and its diagnostics: with particles, with innovations, and with nothing to weigh."""
    run, found = made(request.param)
    path = write_recording(run, tmp_path_factory.mktemp("rrd") / "run.rrd", diagnostics=found)
    return run, found, path


def stored(path: Path) -> Chunks:
    """Path under ``diagnostics/`` -> component or time line -> its rows, those of all chunks in order."""
    rows: Chunks = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(path).stream().filter(content="/diagnostics/**"):
        batch = chunk.to_record_batch()
        for column in batch.schema.names:
            rows[chunk.entity_path.removeprefix("/diagnostics/")][column] += batch.column(column).to_pylist()
    return rows


def scalars(rows: Mapping[str, list[Any]]) -> NDArray[np.float64]:
    return np.array(rows["Scalars:scalars"], dtype=np.float64)


def test_curves_are_those_of_the_diagnostic(recorded: Any) -> None:
    run, found, path = recorded
    rows = stored(path)
    expected = {
        f"{name}/curves/{slug(curve.chart)}/{slug(curve.name)}": curve
        for name, one in found.items()
        for curve in one.curves()
    }
    assert len(expected) == sum(len(one.curves()) for one in found.values()) > 0, "two curves have one path"
    assert {name for name in rows if "/curves/" in name} == expected.keys()
    for name, curve in expected.items():
        assert rows[name][STEP] == list(range(len(run)))
        np.testing.assert_array_equal(scalars(rows[name])[:, 0], curve.values)  # stored as float64
        (said,) = (one for one in rows[name]["SeriesLines:names"] if one)
        assert said == [curve.name]


def test_bounds_and_bands_are_those_of_the_diagnostic(recorded: Any) -> None:
    run, found, path = recorded
    rows = stored(path)
    for name, one in found.items():
        for curve in one.curves():
            bounds = rows.get(f"{name}/bounds/{slug(curve.chart)}")
            if curve.bounds is not None:
                assert bounds is not None
                assert bounds[STEP] == [0, len(run) - 1]
                assert set(curve.bounds) <= set(scalars(bounds)[0]) == set(scalars(bounds)[1])
        for kind, mask in one.bands().items():
            if not mask.any():
                assert f"{name}/bands/{kind}" not in rows
                continue
            changes = rows[f"{name}/bands/{kind}"]
            states = [state[0] == kind for state in changes["StateChange:state"] if state]
            since = np.searchsorted(changes[STEP], np.arange(len(run)), side="right") - 1
            np.testing.assert_array_equal(np.array(states)[since], mask)


def test_words_say_the_verdict_and_every_table(recorded: Any) -> None:
    _, found, path = recorded
    rows = stored(path)
    assert {name.split("/")[0] for name in rows} - {"effective_sample_size"} == set(found)
    for name, one in found.items():
        ((text,),) = rows[f"{name}/about"]["TextDocument:text"]
        assert text.startswith(f"# {DIAGNOSTICS[name].title}\n\n*{DIAGNOSTICS[name].question}*\n\n{one.verdict}\n")
        for curve in one.curves():
            assert f"| {curve.chart} | {curve.name} | {curve.unit} |" in text
        for table in one.tables():
            body = text.split(f"## {table.title}\n\n")[1].split("\n\n")[0].strip().splitlines()
            assert len(body) == 2 + len(table.rows)
            assert {len(re.split(r"(?<!\\)\|", line)) for line in body} == {2 + len(table.columns)}


def test_every_path_is_in_the_schema(recorded: Any) -> None:
    _, _, path = recorded
    templates = {
        re.compile(re.sub(r"\\{\w+\\}", r"\\w+", re.escape(entity.path))): entity
        for entity in SCHEMA
        if entity.path.startswith("diagnostics/")
    }
    for name, rows in stored(path).items():
        (entity,) = (one for template, one in templates.items() if template.fullmatch(f"diagnostics/{name}"))
        assert any(column.startswith(f"{entity.archetype}:") for column in rows), name
        assert entity.static or {STEP, TIME} <= rows.keys(), name


def test_an_import_passes_over_them(recorded: Any, assert_same: Callable[[Trace, Trace], None]) -> None:
    run, _, path = recorded
    assert_same(run, read_recording(path))


def test_each_has_its_tab_and_the_file_is_sound(recorded: Any, tmp_path: Path) -> None:
    _, found, path = recorded
    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    shown = "".join(str(chunk.to_record_batch().to_pydict()) for chunk in reader.stream(store=layout))
    for name, one in found.items():
        assert f"'{DIAGNOSTICS[name].title}'" in shown
        assert all(f"'diagnostics/{name}/curves/{slug(curve.chart)}'" in shown for curve in one.curves())
    rerun = shutil.which("rerun", path=os.path.dirname(sys.executable))
    if rerun is not None:
        home = {"HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
        subprocess.run([rerun, "rrd", "verify", path], check=True, capture_output=True, env=os.environ | home)


class Own(Diagnostic):
    """Of two steps, with everything that can be shown, and names that are hard on paths and tables."""

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

    def pictures(self) -> list[Picture]:
        return [Picture("A picture", np.eye(3))]


def test_a_stream_of_ones_own_takes_any_diagnostic(new_trace: Callable[..., Trace], tmp_path: Path) -> None:
    run = new_trace("ekf", steps=2)
    with rr.RecordingStream("notebook") as stream:
        stream.save(tmp_path / "own.rrd")
        log_diagnostic(stream, Own(), "my own", run)
    assert diagnostic_tab(Own(), "my own").name == "my own"
    rows = stored(tmp_path / "own.rrd")
    assert set(rows) == {
        "my_own/about",
        "my_own/curves/ähnlich_in/kl_image_haptics",
        "my_own/bounds/ähnlich_in",
        "my_own/bands/any_kind",
        "my_own/plots/plot_1",
        "my_own/pictures/a_picture",
    }
    assert scalars(rows["my_own/bounds/ähnlich_in"]).tolist() == [[0.0], [0.0]]  # what is no bound is left out
    assert np.isnan(scalars(rows["my_own/curves/ähnlich_in/kl_image_haptics"])[1, 0])
    ((text,),) = rows["my_own/about"]["TextDocument:text"]
    assert text.startswith("# my own\n\nFine.\n")
    assert r"| x\|y | - |" in text
    with pytest.raises(BadInput, match=r"my own has curves of 2 steps and the trace has 40"):
        log_diagnostic(stream, Own(), "my own", new_trace("ekf"))


def test_the_current_stream_is_the_default(new_trace: Callable[..., Trace], tmp_path: Path) -> None:
    with rr.RecordingStream("notebook") as stream:
        stream.save(tmp_path / "own.rrd")
        log_diagnostic(None, Own(), "own", new_trace("ekf", steps=2))
    assert "own/about" in stored(tmp_path / "own.rrd")

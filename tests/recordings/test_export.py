"""Export and import: files read with third-party readers equal the trace."""

from __future__ import annotations

import base64
import io
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from beliefscope.app.cli.main import main
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.trace import Trace, arrays_of, load_trace, save_trace, trace
from beliefscope.recordings.export import export_trace
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.columns import read_columns
from beliefscope.recordings.log_readers.read_log import read_log
from beliefscope.recordings.rerun_log.columns import columns
from beliefscope.recordings.write import write_recording

pytestmark = pytest.mark.slow

Compare = Callable[[Trace, Trace], None]


@pytest.fixture(scope="module", params=["door crossmodal-pf", "push image-ekf"])
def run(request: pytest.FixtureRequest, short_episodes: Callable[..., list[Episode]]) -> Trace:
    task, name = request.param.split()
    (episode,) = short_episodes(task, [9], 50)
    faults = Faults.parse("blackout=0.3")
    return trace(load_checkpoint(pretrained_path(task, name)), episode, 9, particles=40, faults=faults)


def array_of(trace_: Trace, name: str) -> Any:
    return getattr(trace_ if hasattr(trace_, name) else trace_.episode, name)


def test_columns_contain_every_number_once(run: Trace) -> None:
    arrays = {column.name: column.values for column in columns(run)}
    expected = {name: a for name, a in arrays_of(run).items() if not name.startswith("start_") and a.size}
    assert sum(values.size for values in arrays.values()) == sum(array.size for array in expected.values())
    components = ("hinge_x", "hinge_y", "angle") if run.task.name == "door" else ("x", "y")
    for i, component in enumerate(components):
        np.testing.assert_array_equal(arrays[f"states.{component}"], run.episode.states[:, i])
        np.testing.assert_array_equal(arrays[f"estimate_mean.{component}"], run.estimate_mean[:, i])
        for k, modality in enumerate(run.modalities):
            np.testing.assert_array_equal(arrays[f"modality_mean.{modality}.{component}"], run.modality_mean[:, k, i])
        for j, other in enumerate(components):
            name = f"estimate_covariance.{component}.{other}"
            np.testing.assert_array_equal(arrays[name], run.estimate_covariance[:, i, j])
        if run.particles is not None:
            np.testing.assert_array_equal(arrays[f"particles.{component}"], run.particles[..., i])
        if run.weights is not None and run.weights.shape[-1] > 1:
            np.testing.assert_array_equal(arrays[f"weights.image.{component}"], run.weights[:, 0, i])
    if run.log_likelihood is not None:
        np.testing.assert_array_equal(arrays["log_likelihood.haptics"], run.log_likelihood[:, 1])
        assert run.weights is not None
        np.testing.assert_array_equal(arrays["weights.haptics"], run.weights[:, 1, 0])
    assert {c.name: c.unit for c in columns(run)}[f"estimate_covariance.{components[0]}.{components[0]}"] == "m^2"


def test_parquet(run: Trace, tmp_path: Path) -> None:
    export_trace(run, tmp_path / "run.parquet")
    table = pq.read_table(tmp_path / "run.parquet")
    assert table.column("step").to_pylist() == list(range(len(run)))
    np.testing.assert_allclose(table.column("time"), np.arange(len(run)) * run.episode.dt)
    expected = list(columns(run))
    assert table.column_names == ["step", "time", *(column.name for column in expected)]
    for column in expected:
        stored = table.column(column.name).combine_chunks()
        values = stored.flatten() if column.values.ndim > 1 else stored
        np.testing.assert_array_equal(values.to_numpy(zero_copy_only=False).reshape(column.values.shape), column.values)
        assert values.to_numpy(zero_copy_only=False).dtype == column.values.dtype
        assert table.field(column.name).metadata[b"unit"].decode() == column.unit
    about = json.loads(table.schema.metadata[b"beliefscope"])
    assert (about["filter"], about["data_hash"]) == (run.filter, run.data_hash)
    np.testing.assert_array_equal(np.float32(about["start_mean"]), run.start_mean)
    assert table.field("observations.image").metadata[b"shape"] == b"32,32"


def test_parquet_in_pandas(run: Trace, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    export_trace(run, tmp_path / "run.parquet")
    frame = pandas.read_parquet(tmp_path / "run.parquet").set_index("step")
    component = "hinge_x" if run.task.name == "door" else "x"
    error = frame[f"estimate_mean.{component}"] - frame[f"states.{component}"]
    np.testing.assert_array_equal(error, run.estimate_mean[:, 0] - run.episode.states[:, 0])
    assert np.stack(frame["observations.image"].to_list()).reshape(-1, 32, 32).dtype == np.uint8


def test_npz(run: Trace, tmp_path: Path) -> None:
    export_trace(run, tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz", allow_pickle=False) as file:
        stored = dict(file)
    assert json.loads(str(stored.pop("beliefscope")))["checkpoint_hash"] == run.checkpoint_hash
    expected = arrays_of(run)
    assert stored.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(stored[name], array)
        assert stored[name].dtype == array.dtype


def messages(path: Path) -> dict[str, list[tuple[int, dict[str, Any], dict[str, Any]]]]:
    """Topic -> (time in ns, message, JSON schema), ordered by time."""
    reader = pytest.importorskip("mcap.reader").make_reader(io.BytesIO(path.read_bytes()))
    arrays: dict[str, list[Any]] = {}
    for schema, channel, message in reader.iter_messages():
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        row = (message.log_time, json.loads(message.data), json.loads(schema.data))
        arrays.setdefault(channel.topic, []).append(row)
    return arrays


def test_mcap(run: Trace, tmp_path: Path) -> None:
    export_trace(run, tmp_path / "run.mcap")
    arrays = messages(tmp_path / "run.mcap")
    images = arrays.pop("/observations/image")
    clouds = arrays.pop("/particles", None)
    for topic, rows in arrays.items():
        assert [time for time, _, _ in rows] == [round(t * run.episode.dt * 1e9) for t in range(len(run))]
        assert rows[0][1].keys() == rows[0][2]["properties"].keys(), topic
    for column in columns(run):
        topic = f"/{column.group}/{column.parts[0]}"
        if topic in arrays:
            values = [message for _, message, _ in arrays[topic]]
            for part in column.parts[1:] or ("value",):
                values = [value[part] for value in values]
            np.testing.assert_array_equal(np.array(values).astype(column.values.dtype), column.values)
    expected_images = run.episode.observations["image"]
    for (_, message, schema), image in zip(images, expected_images, strict=True):
        assert (message["encoding"], message["height"], message["width"]) == ("mono8", *image.shape)
        assert base64.b64decode(message["data"]) == image.tobytes()
        assert schema["title"] == "foxglove.RawImage"
    assert (clouds is None) == (run.particles is None)
    if clouds is not None:
        assert run.particles is not None
        assert run.log_weights is not None
        assert [field["name"] for field in clouds[0][1]["fields"]] == ["x", "y", "z", "weight"]
        points = np.stack(
            [np.frombuffer(base64.b64decode(cloud["data"]), "<f4").reshape(-1, 4) for _, cloud, _ in clouds]
        )
        np.testing.assert_array_equal(points[..., :2], run.particles[..., :2])
        np.testing.assert_allclose(points[..., 3].sum(1), 1.0, atol=1e-5)  # float32 over 40 particles
        np.testing.assert_allclose(points[..., 3], np.exp(run.log_weights), rtol=1e-6)


def test_depth_images_are_read_back_from_mcap(run: Trace, tmp_path: Path) -> None:
    pytest.importorskip("mcap.reader")
    depth = np.random.default_rng(0).normal(size=(len(run), 3, 5)).astype(np.float32)
    depth[0, 0] = np.nan, 0.0, -0.0, 1e-40, 3e38
    observations = {**run.episode.observations, "depth": depth}
    export_trace(replace(run, episode=replace(run.episode, observations=observations)), tmp_path / "run.mcap")
    (tmp_path / "map.toml").write_text(
        f'dt = {run.episode.dt}\n[state]\nx = "/trace/states.{run.task.components[0].name}"\n'
        '[sensors]\ndepth = "/observations/depth.data"\n'
    )
    mapping = read_map(tmp_path / "map.toml")
    (episode,) = read_log(read_columns(tmp_path / "run.mcap", mapping), mapping, "run.mcap")
    assert episode.observations["depth"].tobytes() == depth.tobytes()


def test_non_finite_numbers_are_null_in_json(run: Trace, tmp_path: Path) -> None:
    odd = replace(run, estimate_covariance=np.full_like(run.estimate_covariance, np.nan))
    export_trace(odd, tmp_path / "odd.mcap")
    component = "hinge_x" if run.task.name == "door" else "x"
    (_, message, _), *_ = messages(tmp_path / "odd.mcap")["/trace/estimate_covariance"]
    assert message[component][component] is None


def test_missing_package_mcap(run: Trace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mcap", None)  # as if not installed
    with pytest.raises(BadInput, match=r"pip install 'beliefscope\[export\]'"):
        export_trace(run, tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())


def command(line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    monkeypatch.setattr(sys, "argv", ["beliefscope", *line.split(), "--json", "-"])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    return json.loads(capsys.readouterr().out)


@pytest.mark.first(1)
def test_diagnostics_of_an_imported_recording_are_equal(
    run: Trace,
    assert_same: Compare,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The imported trace equals the recorded one, and so do its diagnostics and exports."""
    monkeypatch.chdir(tmp_path)
    diagnostics = quick(run)
    write_recording(run, "run.rrd", diagnostics=diagnostics)
    save_trace(run, Path("original.trace"))
    document = command("import run.rrd -o imported.trace", monkeypatch, capsys)
    assert (document["episode"], document["data_hash"]) == (9, run.data_hash)
    imported = load_trace(Path("imported.trace"))
    assert_same(run, imported)
    assert {n: d.to_dict() for n, d in quick(imported).items()} == {n: d.to_dict() for n, d in diagnostics.items()}
    exports = set()
    for source in ("run.rrd", "imported.trace", "original.trace"):
        command(f"export {source} -o run.parquet", monkeypatch, capsys)
        exports.add(Path("run.parquet").read_bytes())
    assert len(exports) == 1

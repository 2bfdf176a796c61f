"""Invalid and incomplete recordings are rejected with a one-line error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.trace import Trace
from beliefscope.recordings import write
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.schema import APPLICATION


@pytest.fixture
def recording(new_trace: Callable[..., Trace], tmp_path: Path) -> Path:
    return write.write_recording(new_trace("ekf"), tmp_path / "run.rrd")


def message(path: Path) -> str:
    with pytest.raises(BadInput) as caught:
        read_recording(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text


def test_missing_file(tmp_path: Path) -> None:
    assert "no such file" in message(tmp_path / "nothing.rrd")
    assert "no such file" in message(tmp_path)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_truncated_file(recording: Path, share: float) -> None:
    data = recording.read_bytes()
    recording.write_bytes(data[: int(share * len(data))])
    assert "not a complete Rerun recording" in message(recording) or "truncated" in message(recording)


def test_file_of_another_format(tmp_path: Path) -> None:
    path = tmp_path / "foreign.rrd"
    path.write_bytes(np.random.default_rng(0).bytes(10_000))
    assert "not a complete Rerun recording" in message(path)


def test_recording_of_another_application(tmp_path: Path) -> None:
    for application in ("another", APPLICATION):
        path = tmp_path / f"{application}.rrd"
        with rr.RecordingStream(application) as stream:
            stream.save(path)
            stream.log("points", rr.Points3D([[1, 2, 3]]))
        assert "not written by beliefscope" in message(path)


def test_newer_format_version(new_trace: Callable[..., Trace], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(write, "FORMAT_VERSION", 2)
    path = write.write_recording(new_trace("ekf"), tmp_path / "newer.rrd")
    assert "recording format 2, written by " in (text := message(path))
    assert "this version reads format 1" in text


def test_example_file_of_format_1(new_trace: Callable[..., Trace], assert_same: Callable[..., None]) -> None:
    """The file was written by an early version. Later formats add example files of their own."""
    assert_same(read_recording(Path(__file__).with_name("format1.rrd")), new_trace("pf", steps=5, particles=4))


@pytest.mark.parametrize(("probability", "faults"), [(0.0, ""), (0.4, "blackout=0.4")])
def test_recording_without_the_property_faults(
    new_trace: Callable[..., Trace], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, probability: float, faults: str
) -> None:
    trace = replace(new_trace("ekf"), settings={"blackout": probability})
    values = rr.AnyValues
    monkeypatch.setattr(rr, "AnyValues", lambda faults, **others: values(**others))
    imported = read_recording(write.write_recording(trace, tmp_path / "old.rrd"))
    assert imported.faults == Faults.parse(faults)
    np.testing.assert_array_equal(imported.estimate_mean, trace.estimate_mean)


def test_missing_array(recording: Path, tmp_path: Path) -> None:
    """As left by an interrupted live writer: complete chunks, but not of all arrays."""
    from rerun.chunk import RrdReader

    path = tmp_path / "partial.rrd"
    store = RrdReader(recording).recordings()[0]
    RrdReader(recording).stream().drop(content="/trace/effective_weights").write_rrd(
        path, application_id=store.application_id, recording_id=store.recording_id
    )
    assert "trace/effective_weights has 0 of 40 steps; the recording is truncated" in message(path)

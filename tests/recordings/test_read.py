"""Files that are not recordings, or not whole ones: one line that says so."""

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


def test_missing(tmp_path: Path) -> None:
    assert "no such file" in message(tmp_path / "nothing.rrd")
    assert "no such file" in message(tmp_path)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_cut_off(recording: Path, share: float) -> None:
    whole = recording.read_bytes()
    recording.write_bytes(whole[: int(share * len(whole))])
    assert "not a whole Rerun recording" in message(recording) or "cut off" in message(recording)


def test_not_rerun(tmp_path: Path) -> None:
    path = tmp_path / "foreign.rrd"
    path.write_bytes(np.random.default_rng(0).bytes(10_000))
    assert "not a whole Rerun recording" in message(path)


def test_somebody_elses_recording(tmp_path: Path) -> None:
    for application in ("another", APPLICATION):
        path = tmp_path / f"{application}.rrd"
        with rr.RecordingStream(application) as stream:
            stream.save(path)
            stream.log("points", rr.Points3D([[1, 2, 3]]))
        assert "not one that beliefscope wrote" in message(path)


def test_another_format_version(
    new_trace: Callable[..., Trace], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(write, "FORMAT_VERSION", 2)
    path = write.write_recording(new_trace("ekf"), tmp_path / "newer.rrd")
    assert "recording format 2, by " in (said := message(path))
    assert "this version reads format 1" in said in message(path)


def test_a_recording_of_an_older_format(new_trace: Callable[..., Trace], assert_same: Callable[..., None]) -> None:
    """Written when format 1 was new. Each further format keeps one of its own beside it."""
    assert_same(read_recording(Path(__file__).with_name("format1.rrd")), new_trace("pf", steps=5, particles=4))


@pytest.mark.parametrize(("chance", "faults"), [(0.0, ""), (0.4, "blackout=0.4")])
def test_a_recording_from_before_there_were_faults(
    new_trace: Callable[..., Trace], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chance: float, faults: str
) -> None:
    trace = replace(new_trace("ekf"), settings={"blackout": chance})
    values = rr.AnyValues
    monkeypatch.setattr(rr, "AnyValues", lambda faults, **others: values(**others))
    again = read_recording(write.write_recording(trace, tmp_path / "old.rrd"))
    assert again.faults == Faults.parse(faults)
    np.testing.assert_array_equal(again.estimate_mean, trace.estimate_mean)


def test_steps_that_are_missing(recording: Path, tmp_path: Path) -> None:
    """What is left when a live writer stops: whole chunks, but not all of them."""
    from rerun.chunk import RrdReader

    path = tmp_path / "partial.rrd"
    store = RrdReader(recording).recordings()[0]
    RrdReader(recording).stream().drop(content="/trace/acting").write_rrd(
        path, application_id=store.application_id, recording_id=store.recording_id
    )
    assert "trace/acting holds 0 of 40 steps; the recording was cut off" in message(path)

"""A filter that is recorded while it runs: nothing of it is lost or changed, and nothing makes it wait for a view."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch
from rerun.chunk import RrdReader

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.inspect.trace import Trace, begin, load_trace, trace
from beliefscope.inspect.traces.live_file import GrowingReader
from beliefscope.recordings import live, write
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.rerun_log import live_views
from beliefscope.recordings.write import write_recording

Compare = Callable[[Trace, Trace], None]
Run = Callable[[str], tuple[int, str, str]]
HOUSEKEEPING = ("rerun.controls.RowId", "log_time", "log_tick", "start_time")
BLACK = Faults.parse("blackout=0.4")
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "04_own_filter.py"


def cut(episode: Episode, steps: int) -> Episode:
    arrays: dict[str, Any] = {n: getattr(episode, n)[:steps] for n in ("states", "controls", "contact", "qpos")}
    return replace(episode, observations={k: a[:steps] for k, a in episode.observations.items()}, **arrays)


@pytest.fixture(scope="module")
def episode() -> Episode:
    with open_dataset(sample_path("door")) as data:
        return cut(data[9], 35)


@pytest.fixture(params=["crossmodal-ekf", "crossmodal-pf"])
def checkpoint(request: pytest.FixtureRequest) -> Checkpoint:
    return load_checkpoint(shipped("door", request.param))


@torch.no_grad()
def run_live(checkpoint: Checkpoint, episode: Episode, folder: Path) -> LiveRecorder:
    """As a user's loop does it."""
    run = begin(checkpoint, episode, 9, 3, 25, BLACK)
    generator, filter_ = run.generator(), checkpoint.filter
    belief = filter_.start(run.start, 25, generator)
    with LiveRecorder("run", checkpoint, folder=folder, start=run.start, like=episode, **run.given) as recorder:
        for t in range(len(episode)):
            belief, known = filter_.step(belief, run.evidence[t], generator)
            recorder.step(
                known,
                {key: array[t] for key, array in run.episode.observations.items()},
                episode.controls[t],
                truth=episode.states[t],
                contact=bool(episode.contact[t]),
                qpos=episode.qpos[t],
                evidence=run.evidence[t],
            )
    return recorder


def content(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """All that a recording says, in order, but for the moments and numbers that Rerun gives its rows."""
    rows = []
    for chunk in RrdReader(path).stream():
        batch: pa.RecordBatch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name.split(":")[-1] not in HOUSEKEEPING]
        if not chunk.entity_path.startswith("/view"):
            rows.append((chunk.entity_path, batch.select(names).to_pydict()))
    return sorted(rows, key=lambda row: (row[0], sorted(row[1]), str(row[1].get("step"))))


def test_it_is_the_trace_and_its_recording(
    checkpoint: Checkpoint, episode: Episode, assert_same: Compare, tmp_path: Path
) -> None:
    recorder = run_live(checkpoint, episode, tmp_path / "new" / "live")
    whole = trace(checkpoint, episode, 9, 3, 25, BLACK)
    assert (recorder.steps, recorder.waited, recorder.lost) == (35, 0, 0)
    reader = GrowingReader(recorder.path)
    assert (reader.poll(), reader.finished) == (35, True)
    assert_same(reader.part(), whole)
    recording = recorder.path.with_suffix(".rrd")
    assert_same(read_recording(recording), whole)
    again = content(write_recording(whole, tmp_path / "run.rrd"))
    found = content(recording)
    assert [path for path, _ in found] == [path for path, _ in again]
    for (path, one), (_, other) in zip(found, again, strict=True):
        assert repr(one) == repr(other), path  # as text: NaN is like itself
    assert {path.name for path in recorder.path.parent.iterdir()} == {"run.live", "run.rrd"}


def test_a_long_recording_is_laid_out_from_some_of_its_steps(
    episode: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(write, "LAYOUT_STEPS", 10)
    checkpoint = load_checkpoint(shipped("door", "crossmodal-ekf"))
    recorder = run_live(checkpoint, episode, tmp_path)
    again = write_recording(trace(checkpoint, episode, 9, 3, 25, BLACK), tmp_path / "again.rrd")
    assert repr(content(recorder.path.with_suffix(".rrd"))) == repr(content(again))


def own(folder: Path, steps: int, name: str = "run", pause: float = 0.0, **options: Any) -> LiveRecorder:
    """A filter of another kind: step t estimates t, and knows nothing of the truth."""
    with LiveRecorder(name, task="door", folder=folder, **options) as recorder:
        for t in range(steps):
            recorder.step((np.full(3, t, float), (1 + t) * np.eye(3)), {"force": np.full(3, t)}, np.full(7, t))
            time.sleep(pause)
    return recorder


def test_a_filter_of_another_kind_that_knows_no_truth(tmp_path: Path) -> None:
    recorder = own(tmp_path, 23)
    for found in (GrowingReader(recorder.path), read_recording(recorder.path.with_suffix(".rrd"))):
        if isinstance(found, GrowingReader):
            found.poll()
            found = found.part()
        steps = np.arange(23, dtype=np.float32)
        np.testing.assert_array_equal(found.estimate_mean, np.repeat(steps[:, None], 3, axis=1))
        np.testing.assert_array_equal(found.estimate_covariance, (1 + steps)[:, None, None] * np.eye(3))
        np.testing.assert_array_equal(found.episode.observations["force"][:, 0], steps)
        assert (found.kind, found.filter, found.modalities, found.weights) == ("foreign", "own", (), None)
        assert np.isnan(found.episode.states).all()
        assert np.isnan(found.start_mean).all()
        assert found.episode.dt == 0.1
    drawn = {path for path, _ in content(recorder.path.with_suffix(".rrd"))}
    assert "/world/plane/fused/mean" in drawn
    assert "/world/object/truth" not in drawn, "a box of the true door would stand at the origin"


def test_all_names_of_docs_own_filter(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    count, names = 6, ("camera", "touch", "ear")
    said = {
        "estimate_mean": torch.zeros(1, 3),
        "modality_mean": torch.zeros(1, 3, 3),
        "modality_covariance": torch.eye(3).expand(1, 3, 3, 3),
        "weights": torch.full((1, 3, 1), 1 / 3),
        "particles": torch.from_numpy(rng.normal(size=(1, count, 3))),
        "log_weights": torch.zeros(1, count),
        "prior_log_weights": torch.zeros(1, count),
        "log_likelihood": torch.from_numpy(rng.normal(size=(1, 3, count))),
        "ancestors": torch.arange(count)[None],
    }
    with LiveRecorder("run", task="door", modalities=names, folder=tmp_path, filter="mine", seed=4) as recorder:
        for _ in range(3):
            recorder.step(said, {"contact": [1.0]}, truth=[0, 0, 0])
    found = read_recording(recorder.path.with_suffix(".rrd"))
    assert (found.modalities, found.filter, found.seed, found.settings["particles"]) == (names, "mine", 4, count)
    assert found.ancestors is not None
    assert found.ancestors.dtype == np.int32
    assert found.log_weights is not None
    np.testing.assert_allclose(np.exp(found.log_weights).sum(1), 1, rtol=1e-6)
    assert found.episode.contact.all(), "the sensor's, where nobody says better"


def test_what_is_handed_over_may_change_afterwards(tmp_path: Path) -> None:
    """Cameras and filters write into the same memory again."""
    mean, force = np.zeros(3), np.zeros(3)
    with LiveRecorder("run", task="door", folder=tmp_path, views=False) as recorder:
        for t in range(300):
            mean[:], force[:] = t, t
            recorder.step(mean, {"force": force}, truth=mean)
            mean[:], force[:] = -1, -1
    reader = GrowingReader(recorder.path)
    reader.poll()
    found = reader.part()
    for array in (found.estimate_mean, found.episode.observations["force"], found.episode.states):
        np.testing.assert_array_equal(array[:, 0], np.arange(300))
    assert not recorder.path.with_suffix(".rrd").exists()


def test_views_that_hang_keep_nothing_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release, drawing, send = threading.Event(), threading.Event(), live_views.send_part

    def hanging(*arguments: Any) -> None:
        drawing.set()
        assert release.wait(60)
        send(*arguments)

    monkeypatch.setattr(live_views, "send_part", hanging)
    with LiveRecorder("run", task="door", folder=tmp_path) as recorder:
        for _ in range(live_views.DRAWN_AT_ONCE):
            recorder.step(np.zeros(3), {})
        assert drawing.wait(60)
        for _ in range(500):
            recorder.step(np.zeros(3), {})
        reader = GrowingReader(recorder.path)
        until(lambda: reader.poll() == 510)
        release.set()
    assert (recorder.waited, recorder.lost) == (0, 0)
    assert recorder.behind >= 500
    assert len(read_recording(recorder.path.with_suffix(".rrd"))) == 510


def until(what: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while time.monotonic() < end:
        if what():
            return
        time.sleep(0.01)
    pytest.fail("it never was so")


def test_a_disk_that_hangs_is_waited_for_and_that_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release, hanging = threading.Event(), threading.Event()
    blocks: list[int] = []
    append = live.GrowingWriter.append

    def slow(self: Any, part: Trace) -> None:
        if blocks:
            hanging.set()
            assert release.wait(60)
        blocks.append(len(part))
        append(self, part)

    monkeypatch.setattr(live, "WAITING", 20)
    monkeypatch.setattr(live.GrowingWriter, "append", slow)
    with LiveRecorder("run", task="door", folder=tmp_path, views=False) as recorder:
        recorder.step(np.zeros(3), {})
        recorder.step(np.zeros(3), {})
        assert hanging.wait(60)
        for _ in range(20):
            recorder.step(np.zeros(3), {})
        assert recorder.waited == 0, "that many may wait for the disk"
        threading.Timer(0.2, release.set).start()
        recorder.step(np.zeros(3), {})
        assert release.is_set(), "the one above waited until there was room"
    assert (recorder.steps, recorder.waited, recorder.lost) == (23, 1, 0)
    assert sum(blocks) == 23
    assert max(blocks) >= 20, "what waited goes in one block"


def test_what_goes_wrong_later_never_stops_the_filter(tmp_path: Path) -> None:
    recorder = LiveRecorder("run", task="door", folder=tmp_path)

    def loop() -> None:
        with recorder:
            for t in range(200):
                recorder.step(np.full(3, t), {"force": np.zeros(3 if t < 40 else 2)})
                if t == 39:
                    until(lambda: GrowingReader(recorder.path).poll() == 40)

    with pytest.warns(UserWarning, match="ends at step"), pytest.raises(BadInput, match="force as float32"):
        loop()
    reader = GrowingReader(recorder.path)
    assert (reader.poll(), reader.finished, reader.alive) == (40, False, False)
    assert (recorder.steps, recorder.lost) == (200, 160)


def test_an_exception_of_the_filter_leaves_whole_files(tmp_path: Path) -> None:
    recorder = LiveRecorder("run", task="door", folder=tmp_path)

    def loop() -> None:
        with recorder:
            for t in range(9, -1, -1):
                recorder.step(np.full(3, 1 / t), {})

    with pytest.raises(ZeroDivisionError):
        loop()
    reader = GrowingReader(recorder.path)
    assert (reader.poll(), reader.finished) == (9, True)
    assert len(read_recording(recorder.path.with_suffix(".rrd"))) == 9


def test_a_name_that_is_taken_gets_a_number(tmp_path: Path) -> None:
    paths = [own(tmp_path, 2, views=False).path.name for _ in range(3)]
    assert paths == ["run.live", "run-2.live", "run-3.live"]


def test_no_step_no_file(tmp_path: Path) -> None:
    with LiveRecorder("run", task="door", folder=tmp_path):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("known", "observations", "more", "why"),
    [
        ({"estimate": np.zeros(3)}, {}, {}, "value of a filter 'estimate' does not exist"),
        ({"weights": np.ones((2, 1))}, {}, {}, "but not estimate_mean"),
        (np.zeros(2), {}, {}, r"estimate_mean of shape \(1, 2\), expected \(1, 3\)"),
        (np.zeros((2, 3)), {}, {}, r"estimate_mean of shape \(2, 3\), expected \(1, 3\)"),
        (np.array([0, 0, np.nan]), {}, {}, "not finite"),
        (np.zeros(3), {"force": np.zeros(4)}, {}, r"'force' has shape \(1, 4\), not \(1, 3\)"),
        (np.zeros(3), {}, {"control": np.zeros(3)}, r"'controls' has shape \(1, 3\), not \(1, 7\)"),
        (np.zeros(3), {}, {"truth": np.zeros(2)}, r"'states' has shape \(1, 2\), not \(1, 3\)"),
    ],
)
def test_what_cannot_be_recorded_is_said_at_the_first_step(
    tmp_path: Path, known: Any, observations: Any, more: dict[str, Any], why: str
) -> None:
    with pytest.raises(BadInput, match=why), LiveRecorder("run", task="door", folder=tmp_path) as recorder:
        recorder.step(known, observations, **more)
    assert not list(tmp_path.iterdir())


def test_recorders_that_cannot_be(tmp_path: Path, episode: Episode) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="checkpoint, or the name of the task"):
        LiveRecorder("run")
    with pytest.raises(BadInput, match="task 'dor' does not exist"):
        LiveRecorder("run", task="dor")
    with pytest.raises(BadInput, match="a name without a folder"):
        LiveRecorder("../run", task="door")
    with pytest.raises(BadInput, match="cannot make folder"):
        own(tmp_path / "file" / "live", 1)


KILLED = """
import os, signal, sys, time
import numpy as np
from pathlib import Path
from beliefscope.recordings.live import LiveRecorder
folder, last, pause = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
with LiveRecorder("run", task="door", folder=folder) as recorder:
    for t in range(last):
        recorder.step((np.full(3, t, float), (1 + t) * np.eye(3)), {"image": np.full((32, 32), t % 256, np.uint8)})
        time.sleep(pause)
    if sys.argv[4] == "at once":
        os.kill(os.getpid(), signal.SIGKILL)
    print("there", flush=True)
    time.sleep(600)
"""


def drawn(recording: Path) -> int:
    """Complete steps of a recording that grows."""
    with suppress(BadInput):
        return len(read_recording(recording))
    return 0


def killed(folder: Path, last: int, pause: float, when: str) -> int:
    """Steps in the file of a run that was killed; checks that each is what it was, and that the recording opens."""
    command = [sys.executable, "-c", KILLED, str(folder), str(last), str(pause), when]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        if when == "later":
            assert process.stdout.readline() == "there\n"
            until(lambda: GrowingReader(folder / "run.live").poll() == last)
            until(lambda: drawn(folder / "run.rrd") == last)
            process.kill()
        assert process.wait(120) == -signal.SIGKILL
    reader = GrowingReader(folder / "run.live")
    steps = reader.poll()
    assert (reader.finished, reader.alive) == (False, False)
    np.testing.assert_array_equal(reader.part().estimate_mean[:, 0], np.arange(steps))
    np.testing.assert_array_equal(reader.part().episode.observations["image"][:, 3, 3], np.arange(steps) % 256)
    return steps


def test_a_kill_leaves_every_step_that_was_handed_over(run: Run, tmp_path: Path) -> None:
    assert killed(tmp_path, 47, 0.002, "later") == 47
    recording = tmp_path / "run.rrd"
    found = read_recording(recording)
    np.testing.assert_array_equal(found.estimate_mean[:, 0], np.arange(47))
    assert run(f"import {tmp_path}/run.live -o {tmp_path}/run.trace")[0] == 0
    assert len(load_trace(tmp_path / "run.trace")) == 47
    live_views.write_live(tmp_path / "run.live", recording)
    assert len(read_recording(recording)) == 47, "and the whole recording can be made of it"


@pytest.mark.long
@pytest.mark.parametrize("moment", range(12))
def test_a_kill_at_any_moment(tmp_path: Path, moment: int) -> None:
    rng = np.random.default_rng(moment)
    last = int(rng.integers(1, 400))
    steps = killed(tmp_path, last, float(rng.choice([0.0, 0.0005, 0.003])), "at once")
    assert 1 <= steps <= last
    recording = tmp_path / "run.rrd"
    if recording.exists() and recording.stat().st_size:
        rerun = Path(sys.executable).with_name("rerun")
        done = subprocess.run([rerun, "rrd", "stats", recording], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


@pytest.fixture(autouse=True)
def no_grad() -> Iterator[None]:
    yield
    assert torch.is_grad_enabled(), "left as it was"

"""LiveRecorder: recordings equal the trace, survive failures, and never block the filter for a view."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
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
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.live_file import LiveFileReader
from beliefscope.inspect.traces.run import start_run
from beliefscope.recordings import live, write
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.rerun_log import live_views
from beliefscope.recordings.write import write_recording

pytestmark = pytest.mark.slow

Compare = Callable[[Trace, Trace], None]
Run = Callable[[str], tuple[int, str, str]]
HOUSEKEEPING = ("rerun.controls.RowId", "log_time", "log_tick", "start_time")
BLACKOUT = Faults.parse("blackout=0.4")
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
    return load_checkpoint(pretrained_path("door", request.param))


@torch.no_grad()
def run_live(checkpoint: Checkpoint, episode: Episode, folder: Path) -> LiveRecorder:
    """Record a run as in a user's loop."""
    run = start_run(checkpoint, episode, 9, 3, 25, BLACKOUT)
    generator, filter_ = run.generator(), checkpoint.filter
    belief = filter_.start(run.start, 25, generator)
    with LiveRecorder("run", checkpoint, folder=folder, start=run.start, like=episode, **run.provenance) as recorder:
        for t in range(len(episode)):
            belief, values = filter_.step(belief, run.evidence[t], generator)
            recorder.step(
                values,
                {key: array[t] for key, array in run.episode.observations.items()},
                episode.controls[t],
                truth=episode.states[t],
                contact=bool(episode.contact[t]),
                qpos=episode.qpos[t],
                evidence=run.evidence[t],
            )
    return recorder


def content(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """All rows of a recording in order, without Rerun's row ids and log times."""
    rows = []
    for chunk in RrdReader(path).stream():
        batch: pa.RecordBatch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name.split(":")[-1] not in HOUSEKEEPING]
        if not chunk.entity_path.startswith("/view"):
            rows.append((chunk.entity_path, batch.select(names).to_pydict()))
    return sorted(rows, key=lambda row: (row[0], sorted(row[1]), str(row[1].get("step"))))


@pytest.mark.first(1)
def test_files_equal_the_trace_and_its_recording(
    checkpoint: Checkpoint, episode: Episode, assert_same: Compare, tmp_path: Path
) -> None:
    recorder = run_live(checkpoint, episode, tmp_path / "new" / "live")
    expected = trace(checkpoint, episode, 9, 3, 25, BLACKOUT)
    assert (recorder.steps, recorder.waited, recorder.lost) == (35, 0, 0)
    reader = LiveFileReader(recorder.path)
    assert (reader.poll(), reader.finished) == (35, True)
    assert_same(reader.part(), expected)
    recording = recorder.path.with_suffix(".rrd")
    assert_same(read_recording(recording), expected)
    reference = content(write_recording(expected, tmp_path / "run.rrd"))
    rows = content(recording)
    assert [path for path, _ in rows] == [path for path, _ in reference]
    for (path, row), (_, other) in zip(rows, reference, strict=True):
        assert repr(row) == repr(other), path  # as text, in which NaN equals NaN
    assert {path.name for path in recorder.path.parent.iterdir()} == {"run.live", "run.rrd"}


def test_layout_of_a_long_recording_uses_a_subset_of_steps(
    episode: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(write, "LAYOUT_STEPS", 10)
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    recorder = run_live(checkpoint, episode, tmp_path)
    reference = write_recording(trace(checkpoint, episode, 9, 3, 25, BLACKOUT), tmp_path / "reference.rrd")
    assert repr(content(recorder.path.with_suffix(".rrd"))) == repr(content(reference))


def record_external(folder: Path, steps: int, name: str = "run", pause: float = 0.0, **options: Any) -> LiveRecorder:
    """Record an external filter whose estimate at step t is t, without true states."""
    with LiveRecorder(name, task="door", folder=folder, **options) as recorder:
        for t in range(steps):
            recorder.step((np.full(3, t, float), (1 + t) * np.eye(3)), {"force": np.full(3, t)}, np.full(7, t))
            time.sleep(pause)
    return recorder


def test_external_filter_without_true_states(tmp_path: Path) -> None:
    recorder = record_external(tmp_path, 23)
    reader = LiveFileReader(recorder.path)
    reader.poll()
    for recorded in (reader.part(), read_recording(recorder.path.with_suffix(".rrd"))):
        steps = np.arange(23, dtype=np.float32)
        np.testing.assert_array_equal(recorded.estimate_mean, np.repeat(steps[:, None], 3, axis=1))
        np.testing.assert_array_equal(recorded.estimate_covariance, (1 + steps)[:, None, None] * np.eye(3))
        np.testing.assert_array_equal(recorded.episode.observations["force"][:, 0], steps)
        assert (recorded.kind, recorded.filter, recorded.modalities, recorded.weights) == ("external", "own", (), None)
        assert np.isnan(recorded.episode.states).all()
        assert np.isnan(recorded.start_mean).all()
        assert recorded.episode.dt == 0.1
    paths = {path for path, _ in content(recorder.path.with_suffix(".rrd"))}
    assert "/world/plane/fused/mean" in paths
    assert "/world/object/truth" not in paths


def test_all_documented_values_of_external_filters(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    count, names = 6, ("camera", "touch", "ear")
    values = {
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
            recorder.step(values, {"contact": [1.0]}, truth=[0, 0, 0])
    recorded = read_recording(recorder.path.with_suffix(".rrd"))
    assert (recorded.modalities, recorded.filter, recorded.seed, recorded.settings["particles"]) == (
        names,
        "mine",
        4,
        count,
    )
    assert recorded.ancestors is not None
    assert recorded.ancestors.dtype == np.int32
    assert recorded.log_weights is not None
    np.testing.assert_allclose(np.exp(recorded.log_weights).sum(1), 1, rtol=1e-6)
    assert recorded.episode.contact.all(), "the default is the observation"


def test_arrays_are_copied(tmp_path: Path) -> None:
    """Cameras and filters may reuse their buffers."""
    mean, force = np.zeros(3), np.zeros(3)
    with LiveRecorder("run", task="door", folder=tmp_path, views=False) as recorder:
        for t in range(300):
            mean[:], force[:] = t, t
            recorder.step(mean, {"force": force}, truth=mean)
            mean[:], force[:] = -1, -1
    reader = LiveFileReader(recorder.path)
    reader.poll()
    recorded = reader.part()
    for array in (recorded.estimate_mean, recorded.episode.observations["force"], recorded.episode.states):
        np.testing.assert_array_equal(array[:, 0], np.arange(300))
    assert not recorder.path.with_suffix(".rrd").exists()


def test_slow_views_do_not_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release, started, send = threading.Event(), threading.Event(), live_views.send_part

    def hanging(*arguments: Any) -> None:
        started.set()
        assert release.wait(60)
        send(*arguments)

    monkeypatch.setattr(live_views, "send_part", hanging)
    with LiveRecorder("run", task="door", folder=tmp_path) as recorder:
        for _ in range(live_views.MIN_STEPS):
            recorder.step(np.zeros(3), {})
        assert started.wait(60)
        for _ in range(500):
            recorder.step(np.zeros(3), {})
        reader = LiveFileReader(recorder.path)
        until(lambda: reader.poll() == 510)
        release.set()
    assert (recorder.waited, recorder.lost) == (0, 0)
    assert recorder.behind >= 500
    assert len(read_recording(recorder.path.with_suffix(".rrd"))) == 510


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while time.monotonic() < end:
        if condition():
            return
        time.sleep(0.01)
    pytest.fail("timeout")


def test_step_blocks_when_the_queue_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release, hanging = threading.Event(), threading.Event()
    blocks: list[int] = []
    append = live.LiveFileWriter.append

    def slow(self: Any, part: Trace) -> None:
        if blocks:
            hanging.set()
            assert release.wait(60)
        blocks.append(len(part))
        append(self, part)

    monkeypatch.setattr(live, "QUEUE_SIZE", 20)
    monkeypatch.setattr(live.LiveFileWriter, "append", slow)
    with LiveRecorder("run", task="door", folder=tmp_path, views=False) as recorder:
        recorder.step(np.zeros(3), {})
        recorder.step(np.zeros(3), {})
        assert hanging.wait(60)
        for _ in range(20):
            recorder.step(np.zeros(3), {})
        assert recorder.waited == 0, "the queue is not full yet"
        threading.Timer(0.2, release.set).start()
        recorder.step(np.zeros(3), {})
        assert release.is_set(), "the last step waited for the queue"
    assert (recorder.steps, recorder.waited, recorder.lost) == (23, 1, 0)
    assert sum(blocks) == 23
    assert max(blocks) >= 20, "queued steps are written in one block"


def test_later_errors_do_not_stop_the_filter(tmp_path: Path) -> None:
    recorder = LiveRecorder("run", task="door", folder=tmp_path)

    def loop() -> None:
        with recorder:
            for t in range(200):
                recorder.step(np.full(3, t), {"force": np.zeros(3 if t < 40 else 2)})
                if t == 39:
                    until(lambda: LiveFileReader(recorder.path).poll() == 40)

    with pytest.warns(UserWarning, match="ends at step"), pytest.raises(BadInput, match="force as float32"):
        loop()
    reader = LiveFileReader(recorder.path)
    assert (reader.poll(), reader.finished, reader.alive) == (40, False, False)
    assert (recorder.steps, recorder.lost) == (200, 160)


@pytest.mark.parametrize(
    ("later", "message"),
    [
        ({"values": {"estimate": np.zeros(3)}}, "step 3: filter output 'estimate' does not exist"),
        ({"values": ["a", "b", "c"]}, "step 3: TypeError"),
        ({"observations": {"forse": np.zeros(3)}}, "step 3: sensor 'forse' of task 'door' does not exist"),
        ({"covariates": {"fix": True}}, "step 3: covariate 'fix' of task 'door' does not exist"),
    ],
)
def test_later_invalid_arguments_do_not_stop_the_filter(tmp_path: Path, later: dict[str, Any], message: str) -> None:
    usual = {"values": np.zeros(3), "observations": {"force": np.zeros(3)}}
    recorder = LiveRecorder("run", task="door", folder=tmp_path, views=False)

    def loop() -> None:
        with recorder:
            for t in range(6):
                recorder.step(**usual | (later if t == 3 else {}))

    with pytest.warns(UserWarning, match="ends at step"), pytest.raises(BadInput, match=message):
        loop()
    assert (LiveFileReader(recorder.path).poll(), recorder.steps, recorder.lost) == (3, 6, 3)


def test_full_disk_ends_the_views_not_the_run(tmp_path: Path) -> None:
    (tmp_path / "run.rrd").symlink_to("/dev/full")
    with pytest.warns(UserWarning, match="recording of live run .*No space left"):
        recorder = record_external(tmp_path, 30)
    reader = LiveFileReader(recorder.path)
    assert (reader.poll(), reader.finished) == (30, True)


def test_exception_of_the_filter_leaves_complete_files(tmp_path: Path) -> None:
    recorder = LiveRecorder("run", task="door", folder=tmp_path)

    def loop() -> None:
        with recorder:
            for t in range(9, -1, -1):
                recorder.step(np.full(3, 1 / t), {})

    with pytest.raises(ZeroDivisionError):
        loop()
    reader = LiveFileReader(recorder.path)
    assert (reader.poll(), reader.finished) == (9, True)
    assert len(read_recording(recorder.path.with_suffix(".rrd"))) == 9


def test_existing_names_get_a_number(tmp_path: Path) -> None:
    paths = [record_external(tmp_path, 2, views=False).path.name for _ in range(3)]
    assert paths == ["run.live", "run-2.live", "run-3.live"]


def test_no_files_without_steps(tmp_path: Path) -> None:
    with LiveRecorder("run", task="door", folder=tmp_path):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("values", "observations", "options", "message"),
    [
        ({"estimate": np.zeros(3)}, {}, {}, "filter output 'estimate' does not exist"),
        ({"weights": np.ones((2, 1))}, {}, {}, "but not estimate_mean"),
        (np.zeros(2), {}, {}, r"estimate_mean of shape \(1, 2\), expected \(1, 3\)"),
        (np.zeros((2, 3)), {}, {}, r"estimate_mean of shape \(2, 3\), expected \(1, 3\)"),
        (np.array([0, 0, np.nan]), {}, {}, "not finite"),
        (np.zeros(3), {"force": np.zeros(4)}, {}, r"'force' has shape \(1, 4\), not \(1, 3\)"),
        (np.zeros(3), {"forse": np.zeros(3)}, {}, "sensor 'forse' of task 'door' does not exist"),
        (np.zeros(3), {"force": [[1], [1, 2]]}, {}, "ValueError: setting an array element"),
        (np.zeros(3), {}, {"control": np.zeros(3)}, r"'controls' has shape \(1, 3\), not \(1, 7\)"),
        (np.zeros(3), {}, {"truth": np.zeros(2)}, r"'states' has shape \(1, 2\), not \(1, 3\)"),
    ],
)
def test_invalid_values_are_rejected_at_the_first_step(
    tmp_path: Path, values: Any, observations: Any, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(BadInput, match=message), LiveRecorder("run", task="door", folder=tmp_path) as recorder:
        recorder.step(values, observations, **options)
    assert not list(tmp_path.iterdir())


def test_invalid_recorders(tmp_path: Path, episode: Episode) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="checkpoint or the name of its task"):
        LiveRecorder("run")
    with pytest.raises(BadInput, match="task 'dor' does not exist"):
        LiveRecorder("run", task="dor")
    for name in ("../run", "a/run", ".run", ".."):
        with pytest.raises(BadInput, match=r"give a file name, without a folder .* folder="):
            LiveRecorder(name, task="door")
    with pytest.raises(BadInput, match="cannot create folder"):
        record_external(tmp_path / "file" / "live", 1)


@pytest.fixture(autouse=True)
def no_grad() -> Iterator[None]:
    yield
    assert torch.is_grad_enabled(), "recording must not change the gradient mode"

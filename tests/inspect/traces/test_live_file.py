"""Live files: bit-identical to the trace, and robust against truncation and damage."""

from __future__ import annotations

import json
import math
import resource
import struct
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import Trace, arrays_of, header_of, save_trace, trace, trace_from_arrays
from beliefscope.inspect.traces.live_file import MARKER, LiveFileReader, LiveFileWriter, load_live

pytestmark = pytest.mark.slow


def cut(run: Trace, first: int, last: int) -> Trace:
    """Steps ``first`` to ``last - 1`` of a trace."""
    static = ("start_mean", "start_covariance")
    return trace_from_arrays(
        header_of(run), {n: a if n in static else a[first:last] for n, a in arrays_of(run).items()}
    )


def identical(a: Trace, b: Trace) -> bool:
    left, right = arrays_of(a), arrays_of(b)
    types = {name: (array.dtype, array.shape) for name, array in left.items()}
    assert types == {name: (array.dtype, array.shape) for name, array in right.items()}
    assert json.dumps(header_of(a)) == json.dumps(header_of(b))
    return all(array.tobytes() == right[name].tobytes() for name, array in left.items())


def write(path: Path, run: Trace, blocks: list[int], end: bool = True) -> list[int]:
    """Write blocks that end after the given steps; returns the file size after each block."""
    writer, sizes, first = LiveFileWriter(path, run, expected=len(run)), [path.stat().st_size], 0
    for last in blocks:
        writer.append(cut(run, first, last))
        sizes.append(path.stat().st_size)
        first = last
    if end:
        writer.finish()
    writer.close()
    return sizes


@pytest.fixture(scope="module", params=["crossmodal-ekf", "crossmodal-pf", "lstm"])
def run(request: pytest.FixtureRequest) -> Trace:
    """30 steps; the trace of an LSTM has NaN covariances and no modalities."""
    name = request.param
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf" if name == "lstm" else name))
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    episode = replace(
        episode,
        **{a: getattr(episode, a)[:30] for a in ("states", "controls", "contact", "qpos")},
        observations={key: array[:30] for key, array in episode.observations.items()},
    )
    traced = trace(checkpoint, episode, episode_index=9, particles=40)
    if name == "lstm":
        none = {f.name: None for f in fields(Trace) if "None" in str(f.type)}
        mean, covariance = np.zeros((30, 0, 3), np.float32), np.zeros((30, 0, 3, 3), np.float32)
        unknown = np.full((30, 3, 3), np.nan, np.float32)
        none |= {"modalities": (), "modality_mean": mean, "modality_covariance": covariance}
        traced = replace(traced, estimate_covariance=unknown, **none)
    return traced


@pytest.fixture
def short(run: Trace) -> Trace:
    """4 small steps, for tests over every byte."""
    traced = cut(run, 0, 4)
    observations = {key: value for key, value in traced.episode.observations.items() if key in ("force", "contact")}
    arrays: dict[str, np.ndarray] = {
        name: array[..., :2].copy()
        for name, array in arrays_of(traced).items()
        if name in ("log_weights", "prior_log_weights", "log_likelihood")
    }
    if traced.particles is not None and traced.ancestors is not None:
        arrays |= {"particles": traced.particles[:, :2].copy(), "ancestors": traced.ancestors[:, :2] % 2}
    episode = replace(traced.episode, observations=observations, provenance={})
    return replace(traced, episode=episode, settings={}, checkpoint_hash="", data_hash="", **arrays)


def test_read_equals_the_trace(run: Trace, tmp_path: Path) -> None:
    write(tmp_path / "run.live", run, [1, 2, 9, 30])
    reader = LiveFileReader(tmp_path / "run.live")
    assert (reader.poll(), reader.finished, reader.alive, reader.expected) == (30, True, False, 30)
    assert identical(reader.part(), run)
    save_trace(reader.part(), tmp_path / "again.trace")
    save_trace(run, tmp_path / "run.trace")
    assert (tmp_path / "again.trace").read_bytes() == (tmp_path / "run.trace").read_bytes()


@pytest.mark.parametrize(("first", "last"), [(0, 0), (0, 30), (5, 6), (1, 9), (2, 30), (30, 30)])
def test_parts(run: Trace, tmp_path: Path, first: int, last: int) -> None:
    write(tmp_path / "run.live", run, [1, 2, 9, 30])
    reader = LiveFileReader(tmp_path / "run.live")
    reader.poll()
    assert identical(reader.part(first, last), cut(run, first, last))


def test_reader_follows_the_writer(run: Trace, tmp_path: Path) -> None:
    writer = LiveFileWriter(tmp_path / "run.live", run)
    reader = LiveFileReader(tmp_path / "run.live")
    assert (len(reader.read()), len(reader.part()), reader.expected, reader.alive) == (0, 0, None, True)
    parts: list[Trace] = []
    for step in range(30):
        writer.append(cut(run, step, step + 1))
        assert identical(reader.read(), cut(run, step, step + 1))
        parts.append(reader.part())
        assert (reader.steps, reader.finished, reader.alive) == (step + 1, False, True)
    assert len(reader.read()) == 0
    writer.finish()
    assert not reader.alive
    assert (len(reader.read()), reader.finished) == (0, True)
    assert all(identical(a, cut(run, 0, step + 1)) for step, a in enumerate(parts))


def test_poll_without_new_steps_reads_nothing(run: Trace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "run.live", run, list(range(1, 31)), end=False)
    reader = LiveFileReader(tmp_path / "run.live")
    assert (reader.poll(), len(reader.read())) == (30, 30)
    monkeypatch.setattr("os.pread", lambda *_: pytest.fail("read again"))
    assert (reader.poll(), len(reader.read())) == (30, 0)


@pytest.mark.long  # six seconds
@pytest.mark.parametrize("run", ["crossmodal-pf"], indirect=True)
def test_truncation_at_every_byte(short: Trace, tmp_path: Path) -> None:
    """Complete steps are readable; an incomplete header is a one-line error."""
    path = tmp_path / "run.live"
    sizes = write(path, short, [1, 2, 4])
    content = path.read_bytes()
    steps = [0, 1, 2, 4]
    for length in range(len(content)):
        path.write_bytes(content[:length])
        if length < sizes[0]:
            with pytest.raises(BadInput, match=r"incomplete header|not a Beliefscope live run") as caught:
                LiveFileReader(path)
            assert "\n" not in str(caught.value)
            continue
        reader = LiveFileReader(path)
        complete = max(count for count, size in zip(steps, sizes, strict=True) if size <= length)
        assert (reader.poll(), reader.finished, reader.alive) == (complete, False, False)
        assert identical(reader.part(), cut(short, 0, complete))
        reader.close()


@pytest.mark.parametrize("run", ["crossmodal-pf"], indirect=True)
@pytest.mark.long
def test_every_damaged_byte_is_detected(short: Trace, tmp_path: Path) -> None:
    """A file with one modified byte is refused or gives fewer steps, never other numbers."""
    path = tmp_path / "run.live"
    expected = [cut(short, 0, steps) for steps in range(3)]
    sizes = write(path, expected[2], [1, 2])
    content = path.read_bytes()
    for position in range(len(content)):
        path.write_bytes(content[:position] + bytes([content[position] ^ 0x41]) + content[position + 1 :])
        reader = None
        with suppress(BadInput):
            reader = LiveFileReader(path)
            reader.poll()
        assert (reader is None) == (position < sizes[0])
        if reader is not None:
            assert not reader.finished
            assert identical(reader.part(), expected[reader.steps])
            reader.close()


def header_bytes(header: object, static: bytes = b"") -> bytes:
    content = json.dumps(header).encode() + static
    return (
        MARKER.pack(b"BsL\n", len(content), crc32(content, crc32(struct.pack("<4sI", b"BsL\n", len(content)))))
        + content
    )


def test_invalid_headers_are_refused(run: Trace, tmp_path: Path) -> None:
    path = tmp_path / "run.live"
    write(path, run, [30])
    content = path.read_bytes()
    header, _ = json.JSONDecoder().raw_decode(content[MARKER.size :].decode("latin-1"))
    start = run.start_mean.tobytes() + run.start_covariance.tobytes()
    path.write_bytes(header_bytes(header, start))
    LiveFileReader(path).close()
    arrays = header["arrays"]
    for invalid, message in (
        (header | {"format": 2}, "format 2; this version reads format 1"),
        (header | {"arrays": arrays | {"estimate_mean": [[10**12], "<f4"]}}, "bytes per step"),
        (header | {"arrays": arrays | {"estimate_mean": [[-3], "<f4"]}}, "'estimate_mean' of type '<f4'"),
        (header | {"arrays": arrays | {"estimate_mean": [[3], "O"]}}, "'estimate_mean' of type 'O'"),
        (header | {"arrays": arrays | {"estimate_mean": [[3], "nonsense"]}}, "invalid header"),
        (header | {"arrays": arrays | {"estimate_mean": [[3], "9" * 5000]}}, "invalid header"),
        (header | {"expected": math.nan}, "NaN is not a JSON number"),
        (header | {"expected": 10**400}, "401 digits"),
        (header | {"expected": 2.5}, r"expected number of steps is 2\.5"),
        (header | {"expected": -1}, "expected number of steps is -1"),
        (header | {"started": "\ud800"}, "lone surrogate"),
        (header | {"pid": "me"}, "invalid header"),
        (header | {"arrays": {k: v for k, v in arrays.items() if k != "estimate_mean"}}, "estimate_mean"),
        (header | {"trace": header["trace"] | {"colour": 3}}, "colour"),
        (header | {"static": {}}, "invalid header"),
        ([], "invalid header"),
        ("[" * 100_000, "invalid header"),
    ):
        path.write_bytes(header_bytes(invalid, start))
        with pytest.raises(BadInput, match=message):
            LiveFileReader(path)
    path.write_bytes(MARKER.pack(b"BsL\n", 2**32 - 1, 0) + content)
    with pytest.raises(BadInput, match="incomplete header"):
        LiveFileReader(path)
    for b in (b"", b"RRF2" + bytes(100), bytes(100)):
        path.write_bytes(b)
        with pytest.raises(BadInput, match="not a Beliefscope live run"):
            LiveFileReader(path)
    for missing in (tmp_path / "nothing.live", tmp_path):
        with pytest.raises(BadInput, match="does not exist"):
            LiveFileReader(missing)


def test_one_writer_and_one_shape_per_file(run: Trace, tmp_path: Path) -> None:
    writer = LiveFileWriter(tmp_path / "run.live", run)
    with pytest.raises(BadInput, match="File exists"):
        LiveFileWriter(tmp_path / "run.live", run)
    with pytest.raises(BadInput, match="cannot write"):
        LiveFileWriter(tmp_path / "nowhere" / "run.live", run)
    writer.append(cut(run, 0, 2))
    with pytest.raises(BadInput, match=r"estimate_mean as float32 \(2,\), the run started with float32 \(3,\)"):
        writer.append(replace(run, estimate_mean=run.estimate_mean[:, :2]))
    with pytest.raises(BadInput, match="step 2 has weights"):
        writer.append(replace(run, weights=np.zeros((30, 7), np.float32)))
    writer.append(cut(run, 2, 3))
    writer.finish()
    reader = LiveFileReader(tmp_path / "run.live")
    assert identical(reader.read(), cut(run, 0, 3))
    with pytest.raises(BadInput, match=r"steps 2 to 4 are not in .*: it has 3"):
        reader.part(2, 4)


@pytest.mark.parametrize("run", ["crossmodal-ekf"], indirect=True)
def test_full_disk_keeps_complete_steps(run: Trace, tmp_path: Path) -> None:
    path = tmp_path / "run.live"
    writer = LiveFileWriter(path, run)
    header = path.stat().st_size
    writer.append(run)
    size = path.stat().st_size
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + (size - header) // 2, hard))
    try:
        with pytest.raises(BadInput, match="File too large"):
            writer.append(run)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    writer.append(run)
    writer.finish()
    reader = LiveFileReader(path)
    assert (reader.poll(), reader.finished) == (2 * len(run), True)


@pytest.mark.parametrize("run", ["crossmodal-ekf"], indirect=True)
def test_names_of_an_earlier_version(run: Trace, tmp_path: Path) -> None:
    path = tmp_path / "run.live"
    with pytest.MonkeyPatch.context() as patch:
        earlier = {"effective_weights": "acting"}
        patch.setattr(
            "beliefscope.inspect.traces.live_file.arrays_of",
            lambda trace: {earlier.get(name, name): array for name, array in arrays_of(trace).items()},
        )
        write(path, run, [30])
    np.testing.assert_array_equal(load_live(path).effective_weights, run.effective_weights)

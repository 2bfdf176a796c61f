"""Traces that grow on disk: equal to the ordinary one bit by bit, whatever moment the writer stops at."""

from __future__ import annotations

import json
import math
import struct
import subprocess
import sys
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.trace import Trace, arrays_of, header_of, save_trace, trace, trace_from_arrays
from beliefscope.inspect.traces.live_file import MARK, LiveFileReader, LiveFileWriter


def cut(whole: Trace, first: int, last: int) -> Trace:
    """Steps ``first`` to ``last - 1``, without a file."""
    static = ("start_mean", "start_covariance")
    return trace_from_arrays(
        header_of(whole), {n: a if n in static else a[first:last] for n, a in arrays_of(whole).items()}
    )


def same(one: Trace, other: Trace) -> bool:
    left, right = arrays_of(one), arrays_of(other)
    kinds = {name: (array.dtype, array.shape) for name, array in left.items()}
    assert kinds == {name: (array.dtype, array.shape) for name, array in right.items()}
    assert json.dumps(header_of(one)) == json.dumps(header_of(other))
    return all(array.tobytes() == right[name].tobytes() for name, array in left.items())


def write(path: Path, whole: Trace, blocks: list[int], end: bool = True) -> list[int]:
    """Writes it in blocks that end after so many steps; the file's size after each."""
    writer, sizes, first = LiveFileWriter(path, whole, expected=len(whole)), [path.stat().st_size], 0
    for last in blocks:
        writer.append(cut(whole, first, last))
        sizes.append(path.stat().st_size)
        first = last
    if end:
        writer.finish()
    writer.close()
    return sizes


@pytest.fixture(scope="module", params=["crossmodal-ekf", "crossmodal-pf", "lstm"])
def whole(request: pytest.FixtureRequest) -> Trace:
    """30 steps. An LSTM's covariance is NaN and it has no modalities."""
    name = request.param
    checkpoint = load_checkpoint(shipped("door", "crossmodal-ekf" if name == "lstm" else name))
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    episode = replace(
        episode,
        **{one: getattr(episode, one)[:30] for one in ("states", "controls", "contact", "qpos")},
        observations={key: array[:30] for key, array in episode.observations.items()},
    )
    made = trace(checkpoint, episode, episode_index=9, particles=40)
    if name == "lstm":
        none = {f.name: None for f in fields(Trace) if "None" in str(f.type)}
        mean, covariance = np.zeros((30, 0, 3), np.float32), np.zeros((30, 0, 3, 3), np.float32)
        unknown = np.full((30, 3, 3), np.nan, np.float32)
        none |= {"modalities": (), "modality_mean": mean, "modality_covariance": covariance}
        made = replace(made, estimate_covariance=unknown, **none)
    return made


@pytest.fixture
def small(whole: Trace) -> Trace:
    """4 steps of few bytes, for tests that go through every byte."""
    made = cut(whole, 0, 4)
    keep = {key: value for key, value in made.episode.observations.items() if key in ("force", "contact")}
    few: dict[str, np.ndarray] = {
        name: array[..., :2].copy()
        for name, array in arrays_of(made).items()
        if name in ("log_weights", "prior_log_weights", "log_likelihood")
    }
    if made.particles is not None and made.ancestors is not None:
        few |= {"particles": made.particles[:, :2].copy(), "ancestors": made.ancestors[:, :2] % 2}
    return replace(made, episode=replace(made.episode, observations=keep), **few)


def test_what_was_read_is_the_trace(whole: Trace, tmp_path: Path) -> None:
    write(tmp_path / "run.live", whole, [1, 2, 9, 30])
    reader = LiveFileReader(tmp_path / "run.live")
    assert (reader.poll(), reader.finished, reader.alive, reader.expected) == (30, True, False, 30)
    assert same(reader.part(), whole)
    save_trace(reader.part(), tmp_path / "again.trace")
    save_trace(whole, tmp_path / "run.trace")
    assert (tmp_path / "again.trace").read_bytes() == (tmp_path / "run.trace").read_bytes()


@pytest.mark.parametrize(("first", "last"), [(0, 0), (0, 30), (5, 6), (1, 9), (2, 30), (30, 30)])
def test_any_part_is_that_part(whole: Trace, tmp_path: Path, first: int, last: int) -> None:
    write(tmp_path / "run.live", whole, [1, 2, 9, 30])
    reader = LiveFileReader(tmp_path / "run.live")
    reader.poll()
    assert same(reader.part(first, last), cut(whole, first, last))


def test_a_reader_follows_the_writer(whole: Trace, tmp_path: Path) -> None:
    writer = LiveFileWriter(tmp_path / "run.live", whole)
    reader = LiveFileReader(tmp_path / "run.live")
    assert (len(reader.read()), len(reader.part()), reader.expected, reader.alive) == (0, 0, None, True)
    known: list[Trace] = []
    for step in range(30):
        writer.append(cut(whole, step, step + 1))
        assert same(reader.read(), cut(whole, step, step + 1))
        known.append(reader.part())
        assert (reader.steps, reader.finished, reader.alive) == (step + 1, False, True)
    assert len(reader.read()) == 0
    writer.finish()
    assert not reader.alive
    assert (len(reader.read()), reader.finished) == (0, True)
    assert all(same(one, cut(whole, 0, step + 1)) for step, one in enumerate(known)), "what was given never changes"


def test_nothing_is_read_where_nothing_is_new(whole: Trace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "run.live", whole, list(range(1, 31)), end=False)
    reader = LiveFileReader(tmp_path / "run.live")
    assert (reader.poll(), len(reader.read())) == (30, 30)
    monkeypatch.setattr("os.pread", lambda *_: pytest.fail("read again"))
    assert (reader.poll(), len(reader.read())) == (30, 0)


@pytest.mark.parametrize("whole", ["crossmodal-pf"], indirect=True)
def test_cut_at_every_byte(small: Trace, tmp_path: Path) -> None:
    """Whole steps are there, torn ones are not, and a header that is not whole is one line."""
    path = tmp_path / "run.live"
    sizes = write(path, small, [1, 2, 4])
    content = path.read_bytes()
    steps = [0, 1, 2, 4]
    for length in range(len(content)):
        path.write_bytes(content[:length])
        if length < sizes[0]:
            with pytest.raises(BadInput, match=r"no whole header|not a live run") as caught:
                LiveFileReader(path)
            assert "\n" not in str(caught.value)
            continue
        reader = LiveFileReader(path)
        complete = max(count for count, size in zip(steps, sizes, strict=True) if size <= length)
        assert (reader.poll(), reader.finished, reader.alive) == (complete, False, False)
        assert same(reader.part(), cut(small, 0, complete))
        reader.close()


@pytest.mark.parametrize("whole", ["crossmodal-pf"], indirect=True)
def test_every_damaged_byte_is_noticed(small: Trace, tmp_path: Path) -> None:
    """A file with one other byte is refused, or gives fewer steps: never other numbers."""
    path = tmp_path / "run.live"
    sizes = write(path, small, [1, 2, 4])
    content = path.read_bytes()
    for place in range(len(content)):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x41]) + content[place + 1 :])
        reader = None
        with suppress(BadInput):
            reader = LiveFileReader(path)
            reader.poll()
        assert (reader is None) == (place < sizes[0])
        if reader is not None:
            assert not reader.finished
            assert same(reader.part(), cut(small, 0, reader.steps))
            reader.close()


def forged(header: object, static: bytes = b"") -> bytes:
    content = json.dumps(header).encode() + static
    return (
        MARK.pack(b"BsL\n", len(content), crc32(content, crc32(struct.pack("<4sI", b"BsL\n", len(content))))) + content
    )


def test_absurd_headers_are_refused(whole: Trace, tmp_path: Path) -> None:
    path = tmp_path / "run.live"
    write(path, whole, [30])
    content = path.read_bytes()
    header, _ = json.JSONDecoder().raw_decode(content[MARK.size :].decode("latin-1"))
    start = whole.start_mean.tobytes() + whole.start_covariance.tobytes()
    path.write_bytes(forged(header, start))
    LiveFileReader(path).close()
    arrays = header["arrays"]
    for bad, why in (
        (header | {"format": 2}, "format 2; this version reads 1"),
        (header | {"arrays": arrays | {"estimate_mean": [[10**12], "<f4"]}}, "bytes a step"),
        (header | {"arrays": arrays | {"estimate_mean": [[-3], "<f4"]}}, "'estimate_mean' of type '<f4'"),
        (header | {"arrays": arrays | {"estimate_mean": [[3], "O"]}}, "'estimate_mean' of type 'O'"),
        (header | {"arrays": arrays | {"estimate_mean": [[3], "nonsense"]}}, "makes no sense"),
        (header | {"arrays": arrays | {"estimate_mean": [[3], "9" * 5000]}}, "makes no sense"),
        (header | {"expected": math.nan}, "NaN is not a JSON number"),
        (header | {"expected": 10**400}, "401 digits"),
        (header | {"expected": 2.5}, r"it expects 2\.5 steps"),
        (header | {"expected": -1}, "it expects -1 steps"),
        (header | {"started": "\ud800"}, "lone surrogate"),
        (header | {"pid": "me"}, "makes no sense"),
        (header | {"arrays": {k: v for k, v in arrays.items() if k != "estimate_mean"}}, "estimate_mean"),
        (header | {"trace": header["trace"] | {"colour": 3}}, "colour"),
        (header | {"static": {}}, "makes no sense"),
        ([], "makes no sense"),
        ("[" * 100_000, "makes no sense"),
    ):
        path.write_bytes(forged(bad, start))
        with pytest.raises(BadInput, match=why):
            LiveFileReader(path)
    path.write_bytes(MARK.pack(b"BsL\n", 2**32 - 1, 0) + content)
    with pytest.raises(BadInput, match="no whole header"):
        LiveFileReader(path)
    for other in (b"", b"RRF2" + bytes(100), bytes(100)):
        path.write_bytes(other)
        with pytest.raises(BadInput, match="not a live run"):
            LiveFileReader(path)
    for missing in (tmp_path / "nothing.live", tmp_path):
        with pytest.raises(BadInput, match="does not exist"):
            LiveFileReader(missing)


def test_one_file_has_one_writer_and_one_shape(whole: Trace, tmp_path: Path) -> None:
    writer = LiveFileWriter(tmp_path / "run.live", whole)
    with pytest.raises(BadInput, match="File exists"):
        LiveFileWriter(tmp_path / "run.live", whole)
    with pytest.raises(BadInput, match="cannot write"):
        LiveFileWriter(tmp_path / "nowhere" / "run.live", whole)
    writer.append(cut(whole, 0, 2))
    with pytest.raises(BadInput, match=r"estimate_mean as float32 \(2,\), the run began with float32 \(3,\)"):
        writer.append(replace(whole, estimate_mean=whole.estimate_mean[:, :2]))
    with pytest.raises(BadInput, match="step 2 has weights"):
        writer.append(replace(whole, weights=np.zeros((30, 7), np.float32)))
    writer.append(cut(whole, 2, 3))
    writer.finish()
    reader = LiveFileReader(tmp_path / "run.live")
    assert same(reader.read(), cut(whole, 0, 3))
    with pytest.raises(BadInput, match=r"steps 2 to 4 are not in .*: it has 3"):
        reader.part(2, 4)


FULL = """
import resource, sys
from pathlib import Path
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.traces.live_file import LiveFileReader, LiveFileWriter
from beliefscope.inspect.trace import load_trace
whole = load_trace(sys.argv[1])
path = Path(sys.argv[2])
writer = LiveFileWriter(path, whole)
size = path.stat().st_size
writer.append(whole)
step = (path.stat().st_size - size)
resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + step // 2, resource.RLIM_INFINITY))
try:
    writer.append(whole)
    sys.exit("written")
except BadInput as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
writer.append(whole)
writer.finish()
reader = LiveFileReader(path)
assert (reader.poll(), reader.finished) == (2 * len(whole), True)
"""


@pytest.mark.parametrize("whole", ["crossmodal-ekf"], indirect=True)
def test_a_full_disk_leaves_what_was_whole(whole: Trace, tmp_path: Path) -> None:
    save_trace(whole, tmp_path / "run.trace")
    arguments = [str(tmp_path / "run.trace"), str(tmp_path / "run.live")]
    done = subprocess.run([sys.executable, "-c", FULL, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "File too large" in done.stdout

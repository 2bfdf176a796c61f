"""Every reader of files, what a valid file of it is, and how to make it wrong.

Only BadInput may come out of a reader; where none does, what was read must be of use: it can be shown as JSON.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

import mutate
import numpy as np
import torch
from fastapi import HTTPException
from valid_files import AUTHORS, episodes, make_authors, make_episodes, make_push

from beliefscope.app.api.finetune import routes as tuned_routes
from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.runs import kept_filters
from beliefscope.app.runs.trace_store import Library, Settings
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import FAULT_PRESETS, Faults
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, shipped
from beliefscope.filters.training.resume import Partial
from beliefscope.filters.training.study import Cell, rows_of, to_csv, to_markdown
from beliefscope.filters.training.train import PLANS, train
from beliefscope.inspect.diagnostics.base import as_json
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace
from beliefscope.inspect.traces.live_file import GrowingReader, GrowingWriter, load_live
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.write import write_recording


@dataclass(frozen=True)
class Reader:
    """How files of one kind are made, made wrong, and read.

    Attributes:
        make: writes a valid one to the path. spoil: changes it there. read: as the program reads it; raises only
            BadInput.
    """

    make: Callable[[Path], None]
    spoil: Callable[[Path, Random], None]
    read: Callable[[Path], None]
    suffix: str = ""


def rewritten(change: Callable[[bytes, Random], bytes]) -> Callable[[Path, Random], None]:
    """A file is read, changed, and written."""

    def spoil(path: Path, rng: Random) -> None:
        path.write_bytes(change(path.read_bytes(), rng))

    return spoil


def can_be_shown(value: Any) -> None:
    """As the server sends it: neither NaN nor half a character."""
    json.dumps(value, allow_nan=False, ensure_ascii=False).encode()


# Episodes.


def read_episodes(path: Path) -> None:
    for skip_bad in (False, True):
        with open_dataset(path, skip_bad=skip_bad) as data:
            can_be_shown([asdict(summary) for summary in data.summaries])
            for episode in data:
                can_be_shown(dict(episode.provenance))
                Steps.of(data.task, [episode])
            assert len(data.hash) == 64


def read_push(path: Path) -> None:
    with open_dataset(path) as data:
        can_be_shown([asdict(summary) for summary in data.summaries])
        assert np.isfinite(data[0].states).all()
        assert np.isfinite(data[0].observations["force"]).all()


# Filters and their runs.


@cache
def checkpoint(name: str) -> Checkpoint:
    return load_checkpoint(shipped("door", name))


@cache
def traced(name: str) -> Trace:
    return trace(checkpoint(name), episodes()[0], particles=7)


def make_checkpoint(path: Path) -> None:
    small = replace(architecture("door", "crossmodal-ekf"), units=4, image_stride=4)
    filter_ = build(small)
    filter_.statistics.fit(Steps.of(filter_.task, episodes()))
    record = {"metrics": {"0": {"fused": {"rmse": {"angle_deg": 1.0}}}}, "seed": 0, "parent": {"hash": "0" * 64}}
    save_checkpoint(filter_, "crossmodal-ekf", record, path)


def read_checkpoint(path: Path) -> None:
    found = load_checkpoint(path)
    can_be_shown({"name": found.name, **found.record})
    assert all(torch.isfinite(value).all() for value in found.filter.state_dict().values())


def read_trace(read: Callable[[Path], Trace], path: Path) -> None:
    found = read(path)
    can_be_shown(as_json({name: getattr(found, name) for name in ("filter", "modalities", "settings", "seed")}))
    assert len(found.estimate_mean) == len(found.episode.states) == len(found)
    found.episode.digest()


def make_live(path: Path) -> None:
    writer = GrowingWriter(path, traced("crossmodal-pf"), expected=18)
    for _ in range(3):
        writer.append(traced("crossmodal-pf"))
    writer.finish()


def read_live(path: Path) -> None:
    """As a page that follows it, up to where the damage begins; then as a command, which takes it whole or not."""
    reader = GrowingReader(path)
    try:
        with suppress(BadInput):
            reader.poll()
        can_be_shown([reader.steps, reader.finished, reader.expected, reader.started, reader.alive])
        assert len(reader.part()) == reader.steps
        assert len(reader.part(0, stride=2)) == (reader.steps + 1) // 2
    finally:
        reader.close()
    read_trace(load_live, path)


# What a study, a training, a server leave in their folders.


@cache
def cell() -> Cell:
    return Cell("door", "haptics-ekf", 0, "smoke", "door", Path("door.h5"), "0" * 64)


@cache
def document() -> dict[str, Any]:
    trained = train(architecture("door", "haptics-ekf"), episodes(steps=20), data_hash="0" * 64, plan=PLANS["smoke"])
    trivial = {"hinge_x_cm": 1.0, "hinge_y_cm": 1.0, "angle_deg": 1.0, "position_cm": 1.0}
    return trained.record | cell().depends_on() | {"checkpoint_hash": _sha(b"weights"), "trivial": trivial}


def _sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def make_cell(path: Path) -> None:
    path.write_text(json.dumps(document()))


def read_cell(path: Path) -> None:
    folder = path.parent / "study"
    there = cell().path(folder)
    there.parent.mkdir(parents=True, exist_ok=True)
    there.write_bytes(path.read_bytes())
    cell().path(folder, ".safetensors").write_bytes(b"weights")
    found = cell().document(folder)
    rows = rows_of({cell(): found})
    to_csv(rows)
    to_markdown(rows)
    if found is None:
        raise BadInput("no cell of this study")


def make_partial(path: Path) -> None:
    tensors = {"now.weight": torch.arange(6.0).reshape(2, 3)}
    Partial(path, "key").save(tensors, {"done": ["dynamics"], "seconds": 1.5})


def read_partial(path: Path) -> None:
    """What is taken up must be what was put down: a training cannot tell wrong weights from right ones."""
    found = Partial(path, "key").load()
    if found is None:
        raise BadInput("of no use")
    assert torch.equal(found[0]["now.weight"], torch.arange(6.0).reshape(2, 3))
    assert found[1]["done"] == ["dynamics"]
    assert found[1]["seconds"] == 1.5


def make_job(path: Path) -> None:
    job = Job("job", "report", "A report", "done", 1.0, asked=1e9, started=1e9, ended=1e9, link="?tab=failures")
    path.write_text(json.dumps(asdict(job)))


def read_job(path: Path) -> None:
    folder = path.parent / "jobs"
    (folder / "job").mkdir(parents=True, exist_ok=True)
    shutil.copy(path, folder / "job" / "job.json")
    jobs = Jobs(folder).all()
    can_be_shown([asdict(job) for job in jobs])
    if not jobs:
        raise BadInput("no job of ours")


def make_children(path: Path) -> None:
    own = kept_filters.Child("door", "mine", str(shipped("door", "image-ekf")), True)
    path.write_text(json.dumps([asdict(own)]))


def read_children(path: Path) -> None:
    shutil.copy(path, path.parent / kept_filters.FILE)
    settings = kept_filters.with_children(Settings(path.parent))
    can_be_shown(settings.to_json())
    if not settings.checkpoints:
        raise BadInput("no child of ours")


RUN_FILES = ("run", "progress", "found")


def make_run(path: Path) -> None:
    asked: dict[str, Any] = {"steps": 3}
    about = {"run": "run", "task": "door", "filter": "haptics-ekf", "data": "sample", "settings": asked, "asked": 1.5}
    look = {"step": 0, "loss": None, "slices": {"nominal": {"rmse": {}}}, "score": 1.0}
    files = {"run": about, "progress": {"steps": 3, "losses": [[1, 0.5]], "looks": [look]}, "found": {"moments": []}}
    path.write_text(json.dumps(files))


def spoil_run(path: Path, rng: Random) -> None:
    files = json.loads(path.read_bytes())
    name = rng.choice(RUN_FILES)
    path.with_suffix(".name").write_text(name)
    path.write_bytes(mutate.spoiled_json(json.dumps(files[name]).encode(), rng))


@cache
def tuned() -> dict[str, Callable[..., Any]]:
    """The routes of fine-tuning over an empty library, by name."""
    folder = Path(_workspace())
    library = Library(Settings(folder))
    return {route.name: route.endpoint for route in tuned_routes(library, Jobs(folder / "jobs")).routes}  # type: ignore[attr-defined]


@cache
def _workspace() -> str:
    return tempfile.mkdtemp(prefix="workspace-")


def read_run(path: Path) -> None:
    folder = Path(_workspace()) / "finetune" / "run"
    folder.mkdir(parents=True, exist_ok=True)
    make_run(path.with_suffix(".whole"))
    for name, content in json.loads(path.with_suffix(".whole").read_bytes()).items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    if path.with_suffix(".name").exists():
        shutil.copy(path, folder / f"{path.with_suffix('.name').read_text()}.json")
    shutil.copy(shipped("door", "haptics-ekf"), folder / "child.safetensors")
    try:
        can_be_shown(tuned()["how"]("run"))
    except HTTPException as error:
        raise BadInput(error.detail) from None


def server(folder: Path) -> Settings:
    """What a server is given that shall be quick: few steps, few particles, small networks."""
    make_episodes(folder / "mine.h5")
    make_checkpoint(folder / "small.safetensors")
    data, checkpoints = {"mine": folder / "mine.h5"}, {"small": folder / "small.safetensors"}
    return Settings(folder / "workspace", data, checkpoints, particles=7)


# Fault injections: text and JSON.


def make_faults(path: Path) -> None:
    path.write_text(",".join(FAULT_PRESETS.values()))


def spoil_faults(path: Path, rng: Random) -> None:
    text = ",".join(rng.sample(list(FAULT_PRESETS.values()), rng.randint(1, 3)))
    if rng.random() < 0.5:
        text = mutate.spoiled_json(json.dumps(Faults.parse(text).to_json()).encode(), rng).decode(errors="replace")
    else:
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(text) + 1)
            pieces = (*",:=[]{}", "from=", "to=", *mutate.TEXTS, *map(str, mutate.NUMBERS))
            text = text[:at] + rng.choice(pieces) + text[at + rng.randrange(4) :]
    path.write_bytes(text.encode(errors="surrogatepass"))


def read_faults(path: Path) -> None:
    faults = Faults.parse(path.read_bytes().decode(errors="surrogatepass"))
    can_be_shown(faults.to_json())
    broken = faults.apply(episodes()[0])
    assert np.isfinite(broken.observations["force"]).all()
    assert Faults.parse(str(faults)) == faults == Faults.of(faults.to_json())


CHECKPOINT, TRACE = "beliefscope", "beliefscope-trace"


def _with_header(key: str) -> Callable[[Path, Random], None]:
    return rewritten(lambda data, rng: mutate.spoiled_safetensors(data, rng, key))


HDF5 = ("episodes", "authors-door", "authors-push", "authors-real", "mit-hdf5")

READERS: dict[str, Reader] = {
    "episodes": Reader(make_episodes, mutate.spoil_hdf5, read_episodes, ".h5"),
    "authors-door": Reader(partial(make_authors, keys=AUTHORS[0]), mutate.spoil_hdf5, read_episodes, ".hdf5"),
    "authors-push": Reader(partial(make_authors, keys=AUTHORS[1]), mutate.spoil_hdf5, read_episodes, ".hdf5"),
    "authors-real": Reader(partial(make_authors, keys=AUTHORS[2]), mutate.spoil_hdf5, read_episodes, ".hdf5"),
    "mit-json": Reader(make_push, rewritten(mutate.spoiled_json), read_push, ".json"),
    "mit-hdf5": Reader(make_push, mutate.spoil_hdf5, read_push, ".h5"),
    "checkpoint": Reader(make_checkpoint, _with_header(CHECKPOINT), read_checkpoint, ".safetensors"),
    "trace-ekf": Reader(
        lambda path: save_trace(traced("crossmodal-ekf"), path), _with_header(TRACE), partial(read_trace, load_trace)
    ),
    "trace-pf": Reader(
        lambda path: save_trace(traced("crossmodal-pf"), path), _with_header(TRACE), partial(read_trace, load_trace)
    ),
    "live": Reader(make_live, rewritten(mutate.spoiled_live), read_live, ".live"),
    "recording": Reader(
        lambda path: write_recording(traced("crossmodal-pf"), path),
        rewritten(mutate.damaged),
        partial(read_trace, read_recording),
        ".rrd",
    ),
    "faults": Reader(make_faults, spoil_faults, read_faults),
    "study": Reader(make_cell, rewritten(mutate.spoiled_json), read_cell, ".json"),
    "partial": Reader(make_partial, _with_header("kept"), read_partial),
    "job": Reader(make_job, rewritten(mutate.spoiled_json), read_job, ".json"),
    "children": Reader(make_children, rewritten(mutate.spoiled_json), read_children, ".json"),
    "tuned run": Reader(make_run, spoil_run, read_run, ".json"),
}
"""What is read -> its reader. A new one is a line here."""


def check_whole(name: str, folder: Path) -> None:
    """That the reader takes a valid file, or nothing would be tried here."""
    path = folder / f"motion_surface=abs_shape=rect1_whole{READERS[name].suffix}"
    READERS[name].make(path)
    READERS[name].read(path)


@contextmanager
def spoiled(name: str, seed: int, number: int, folder: Path) -> Iterator[Path]:
    """The wrong file of this number: the same for the same seed."""
    reader = READERS[name]
    whole, path = folder / f"whole{reader.suffix}", folder / f"motion_surface=abs_shape=rect1_{number}{reader.suffix}"
    if not whole.exists():
        reader.make(whole)
    shutil.copy(whole, path)
    try:
        reader.spoil(path, Random(f"{seed} {name} {number}"))
        yield path
    finally:
        for left in folder.glob(f"{path.stem}.*"):
            left.unlink()


def attempt(name: str, seed: int, number: int, folder: Path) -> str:
    """``read`` or ``refused``. Raises whatever else comes out of the reader."""
    with spoiled(name, seed, number, folder) as path:
        try:
            READERS[name].read(path)
        except BadInput as error:
            said = str(error)
            assert said, "an error without words"
            assert "\n" not in said or name in ("recording",), f"more than one line: {said[:300]!r}"
            return "refused"
    return "read"

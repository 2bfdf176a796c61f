"""File readers under test: how to write a valid file, corrupt it and read it.

A reader may raise only BadInput. Otherwise its result must be usable, in particular serializable as JSON.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

import mutate
import numpy as np
import torch
from fastapi import FastAPI
from log_readers import LOG_READERS
from reader import Corrupt, Reader, check_serializable, corrupt_with
from starlette.testclient import TestClient
from valid_files import PAPER_LAYOUTS, episodes, write_episodes, write_paper_file, write_push

from beliefscope.app.api.finetune import add_routes
from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace import saved_filters
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import FAULT_PRESETS, Faults
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.filters.training.plan import PLANS
from beliefscope.filters.training.resume import Partial
from beliefscope.filters.training.study import Cell
from beliefscope.filters.training.study_table import rows_of, to_csv, to_markdown
from beliefscope.filters.training.train import train
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace
from beliefscope.inspect.traces.live_file import LiveFileReader, LiveFileWriter, load_live
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.write import write_recording

# Episodes.


def read_episodes(path: Path) -> None:
    for skip_bad in (False, True):
        with open_dataset(path, skip_bad=skip_bad) as data:
            check_serializable([asdict(summary) for summary in data.summaries])
            for episode in data:
                check_serializable(dict(episode.provenance))
                Steps.from_episodes(data.task, [episode])
            assert len(data.hash) == 64


def read_push(path: Path) -> None:
    with open_dataset(path) as data:
        check_serializable([asdict(summary) for summary in data.summaries])
        assert np.isfinite(data[0].states).all()
        assert np.isfinite(data[0].observations["force"]).all()


# Checkpoints, traces and live files.


@cache
def checkpoint(name: str) -> Checkpoint:
    return load_checkpoint(pretrained_path("door", name))


@cache
def example_trace(name: str) -> Trace:
    return trace(checkpoint(name), episodes()[0], particles=7)


def write_checkpoint(path: Path) -> None:
    small = replace(architecture("door", "crossmodal-ekf"), units=4, image_stride=4)
    filter_ = build(small)
    filter_.statistics.fit(Steps.from_episodes(filter_.task, episodes()))
    record = {"metrics": {"0": {"fused": {"rmse": {"angle_deg": 1.0}}}}, "seed": 0, "base": {"hash": "0" * 64}}
    save_checkpoint(filter_, "crossmodal-ekf", record, path)


def read_checkpoint(path: Path) -> None:
    result = load_checkpoint(path)
    check_serializable({"name": result.name, **result.record})
    assert all(torch.isfinite(value).all() for value in result.filter.state_dict().values())


def read_trace(load: Callable[[Path], Trace], path: Path) -> None:
    result = load(path)
    check_serializable(as_json({name: getattr(result, name) for name in ("filter", "modalities", "settings", "seed")}))
    assert len(result.estimate_mean) == len(result.episode.states) == len(result)
    result.episode.digest()


def write_live(path: Path) -> None:
    writer = LiveFileWriter(path, example_trace("crossmodal-pf"), expected=18)
    for _ in range(3):
        writer.append(example_trace("crossmodal-pf"))
    writer.finish()


def read_live(path: Path) -> None:
    """Read the valid part, as the page does, then the complete file, as the command line does."""
    reader = LiveFileReader(path)
    try:
        with suppress(BadInput):
            reader.poll()
        check_serializable([reader.steps, reader.finished, reader.expected, reader.started, reader.alive])
        assert len(reader.part()) == reader.steps
        assert len(reader.part(0, stride=2)) == (reader.steps + 1) // 2
    finally:
        reader.close()
    read_trace(load_live, path)


# Files of studies, trainings and the server's workspace.


@cache
def cell() -> Cell:
    return Cell("door", "haptics-ekf", 0, "smoke", "door", Path("door.h5"), "0" * 64)


@cache
def cell_document() -> dict[str, Any]:
    trained = train(architecture("door", "haptics-ekf"), episodes(steps=20), data_hash="0" * 64, plan=PLANS["smoke"])
    trivial = {"hinge_x_cm": 1.0, "hinge_y_cm": 1.0, "angle_deg": 1.0, "position_cm": 1.0}
    checkpoint_hash = hashlib.sha256(b"weights").hexdigest()
    return trained.record | cell().inputs() | {"checkpoint_hash": checkpoint_hash, "trivial": trivial}


def write_cell(path: Path) -> None:
    path.write_text(json.dumps(cell_document()))


def read_cell(path: Path) -> None:
    folder = path.parent / "study"
    target = cell().path(folder)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(path.read_bytes())
    cell().path(folder, ".safetensors").write_bytes(b"weights")
    document = cell().document(folder)
    rows = rows_of({cell(): document})
    to_csv(rows)
    to_markdown(rows)
    if document is None:
        raise BadInput("not a cell of this study")


def write_partial(path: Path) -> None:
    tensors = {"now.weight": torch.arange(6.0).reshape(2, 3)}
    Partial(path, "key").save(tensors, {"done": ["dynamics"], "seconds": 1.5})


def read_partial(path: Path) -> None:
    """Accepted content must be unchanged: a training cannot detect wrong weights."""
    content = Partial(path, "key").load()
    if content is None:
        raise BadInput("unusable")
    tensors, progress = content
    assert torch.equal(tensors["now.weight"], torch.arange(6.0).reshape(2, 3))
    assert (progress["done"], progress["seconds"]) == (["dynamics"], 1.5)


def write_job(path: Path) -> None:
    job = Job("job", "report", "A report", "done", 1.0, submitted=1e9, started=1e9, ended=1e9, link="?tab=failures")
    path.write_text(json.dumps(asdict(job)))


def read_job(path: Path) -> None:
    folder = path.parent / "jobs"
    (folder / "job").mkdir(parents=True, exist_ok=True)
    shutil.copy(path, folder / "job" / "job.json")
    jobs = Jobs(folder).all()
    check_serializable([asdict(job) for job in jobs])
    if not jobs:
        raise BadInput("not a job record")


def write_saved_filters(path: Path) -> None:
    saved = saved_filters.SavedFilter("door", "mine", str(pretrained_path("door", "image-ekf")), True)
    path.write_text(json.dumps([asdict(saved)]))


def read_saved_filters(path: Path) -> None:
    shutil.copy(path, path.parent / saved_filters.FILE)
    saved = saved_filters.SavedFilters(path.parent).all()
    check_serializable([asdict(filter_) for filter_ in saved])
    if not saved:
        raise BadInput("not a list of saved filters")


RUN_FILES = ("run", "progress", "result")


def finetune_files() -> dict[str, Any]:
    run = {"run": "run", "task": "door", "filter": "haptics-ekf", "data": "sample", "settings": {"steps": 3}}
    validation = {"step": 0, "loss": None, "slices": {"clean": {"rmse": {}}}, "score": 1.0}
    progress = {"steps": 3, "losses": [[1, 0.5]], "validations": [validation]}
    return {"run": run | {"submitted": 1.5}, "progress": progress, "result": {"events": []}}


def write_finetune(path: Path) -> None:
    path.write_text(json.dumps(finetune_files()))


def corrupt_finetune(path: Path, rng: Random) -> None:
    name = rng.choice(RUN_FILES)
    path.with_suffix(".name").write_text(name)
    path.write_bytes(mutate.corrupt_json(json.dumps(finetune_files()[name]).encode(), rng))


@cache
def finetune_server() -> tuple[Path, TestClient]:
    """An empty workspace and a server of its fine-tuning routes."""
    folder, application = Path(tempfile.mkdtemp(prefix="workspace-")), FastAPI()
    add_routes(application, TraceStore(Settings(folder)), Jobs(folder / "jobs"))
    return folder, TestClient(application)


def read_finetune(path: Path) -> None:
    workspace, client = finetune_server()
    folder = workspace / "finetune" / "run"
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in finetune_files().items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    if path.with_suffix(".name").exists():
        shutil.copy(path, folder / f"{path.with_suffix('.name').read_text()}.json")
    shutil.copy(pretrained_path("door", "haptics-ekf"), folder / "finetuned.safetensors")
    response = client.get("/api/tuned/run")
    if response.is_error:
        raise BadInput(response.text)


# Fault injections: text and JSON.


def write_faults(path: Path) -> None:
    path.write_text(",".join(FAULT_PRESETS.values()))


def corrupt_faults(path: Path, rng: Random) -> None:
    text = ",".join(rng.sample(list(FAULT_PRESETS.values()), rng.randint(1, 3)))
    if rng.random() < 0.5:
        text = mutate.corrupt_json(json.dumps(Faults.parse(text).to_json()).encode(), rng).decode(errors="replace")
    else:
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(text) + 1)
            pieces = (*",:=[]{}", "from=", "to=", *mutate.TEXTS, *map(str, mutate.NUMBERS))
            text = text[:at] + rng.choice(pieces) + text[at + rng.randrange(4) :]
    path.write_bytes(text.encode(errors="surrogatepass"))


def read_faults(path: Path) -> None:
    faults = Faults.parse(path.read_bytes().decode(errors="surrogatepass"))
    check_serializable(faults.to_json())
    episode = faults.apply(episodes()[0])
    assert np.isfinite(episode.observations["force"]).all()
    assert Faults.parse(str(faults)) == faults == Faults.from_json(faults.to_json())


def corrupt_safetensors(key: str) -> Corrupt:
    return corrupt_with(lambda data, rng: mutate.corrupt_safetensors(data, rng, key))


CORRUPT_JSON, CORRUPT_TRACE = corrupt_with(mutate.corrupt_json), corrupt_safetensors("beliefscope-trace")

READERS: dict[str, Reader] = {
    "episodes": Reader(write_episodes, mutate.corrupt_hdf5, read_episodes, ".h5"),
    **{
        f"paper-{name}": Reader(partial(write_paper_file, keys=keys), mutate.corrupt_hdf5, read_episodes, ".hdf5")
        for name, keys in PAPER_LAYOUTS.items()
    },
    "mit-json": Reader(write_push, CORRUPT_JSON, read_push, ".json"),
    "mit-hdf5": Reader(write_push, mutate.corrupt_hdf5, read_push, ".h5"),
    "checkpoint": Reader(write_checkpoint, corrupt_safetensors("beliefscope"), read_checkpoint, ".safetensors"),
    "trace-ekf": Reader(
        lambda path: save_trace(example_trace("crossmodal-ekf"), path), CORRUPT_TRACE, partial(read_trace, load_trace)
    ),
    "trace-pf": Reader(
        lambda path: save_trace(example_trace("crossmodal-pf"), path), CORRUPT_TRACE, partial(read_trace, load_trace)
    ),
    "live": Reader(write_live, corrupt_with(mutate.corrupt_live), read_live, ".live"),
    "recording": Reader(
        lambda path: write_recording(example_trace("crossmodal-pf"), path),
        corrupt_with(mutate.corrupt_bytes),
        partial(read_trace, read_recording),
        ".rrd",
    ),
    "faults": Reader(write_faults, corrupt_faults, read_faults),
    "study": Reader(write_cell, CORRUPT_JSON, read_cell, ".json"),
    "partial": Reader(write_partial, corrupt_safetensors("kept"), read_partial),
    "job": Reader(write_job, CORRUPT_JSON, read_job, ".json"),
    "saved-filters": Reader(write_saved_filters, CORRUPT_JSON, read_saved_filters, ".json"),
    "finetune": Reader(write_finetune, corrupt_finetune, read_finetune, ".json"),
    **LOG_READERS,
}
"""Readers by name."""

HDF5 = tuple(name for name, reader in READERS.items() if reader.corrupt is mutate.corrupt_hdf5)


def check_valid(name: str, folder: Path) -> None:
    """Check that the reader accepts a valid file."""
    path = folder / f"motion_surface=abs_shape=rect1_valid{READERS[name].suffix}"
    READERS[name].write(path)
    READERS[name].read(path)


def copy(source: Path, target: Path) -> None:
    """Copy a file or a folder; replace what a killed process left."""
    if target.is_dir():
        shutil.rmtree(target)
    (shutil.copytree if source.is_dir() else shutil.copy)(source, target)


@contextmanager
def corrupted(name: str, seed: int, number: int, folder: Path) -> Iterator[Path]:
    """The corrupt file with this number; deterministic for a seed."""
    reader = READERS[name]
    valid, path = folder / f"valid{reader.suffix}", folder / f"motion_surface=abs_shape=rect1_{number}{reader.suffix}"
    if not valid.exists():
        reader.write(valid)
    copy(valid, path)
    try:
        reader.corrupt(path, Random(f"{seed} {name} {number}"))
        yield path
    finally:
        for file in folder.glob(f"{path.stem}.*"):
            shutil.rmtree(file) if file.is_dir() else file.unlink()


def attempt(name: str, seed: int, number: int, folder: Path) -> str:
    """Read a corrupt file: ``read`` or ``refused``. Raises every exception except BadInput."""
    with corrupted(name, seed, number, folder) as path:
        try:
            READERS[name].read(path)
        except BadInput as error:
            message = str(error)
            assert message, "empty error message"
            assert "\n" not in message or name == "recording", f"more than one line: {message[:300]!r}"
            return "refused"
    return "read"


def server_settings(folder: Path) -> Settings:
    """Settings of a fast server: few steps, few particles, small networks."""
    write_episodes(folder / "mine.h5")
    write_checkpoint(folder / "small.safetensors")
    data, checkpoints = {"mine": folder / "mine.h5"}, {"small": folder / "small.safetensors"}
    return Settings(folder / "workspace", data, checkpoints, particles=7)

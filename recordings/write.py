"""Trace -> ``.rrd``. The file is complete or not there: it is written under another name and then renamed."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from errno import ENOSPC
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.any_batch_value import AnyBatchValue
from rerun.chunk import RrdReader
from rerun_bindings import flush_and_cleanup_orphaned_recordings

import beliefscope
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import unwritable
from beliefscope.datasets.task import Task
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.trace import Trace, arrays_of, header_of, trace_of
from beliefscope.inspect.traces.live_file import STATIC
from beliefscope.recordings.rerun_log import entities
from beliefscope.recordings.rerun_log.blueprint import blueprint
from beliefscope.recordings.rerun_log.bodies import Bodies
from beliefscope.recordings.rerun_log.diagnostics import log_diagnostic
from beliefscope.recordings.rerun_log.maps import map_columns, map_style
from beliefscope.recordings.schema import APPLICATION, FORMAT_VERSION, GROWING, SCHEMA, TRACE_COMPONENT

STEPS_PER_CHUNK, CHUNKS = 100, 100
"""Steps at least that are sent at once, and how often at most: Rerun keeps an index in memory
until the file ends, some 0.4 MB each time."""

MAPS_PER_CHUNK = 16
LAYOUT_STEPS = 1000


def write_recording(
    trace: Trace,
    path: str | Path,
    maps: Iterable[LikelihoodMap] | None = None,
    progress: Callable[[float], None] | None = None,
    diagnostics: Mapping[str, Diagnostic] = MappingProxyType({}),
) -> Path:
    """Write a recording that Rerun's own viewer opens with its layout, and ``read_recording`` reads back.

    Args:
        trace: of a task in ``TASKS``.
        path: of the ``.rrd`` file. A file that is there is replaced once the new one is complete.
        maps: likelihood maps of steps of this trace, all of one size, each step at most once; they are taken block by
            block, so they may be made while being written. Kept as 8-bit shares of their layer's maximum: the error
            is at most 1/510 of it.
        progress: called with the share that is done, 0 to 1.
        diagnostics: of this trace, by name: each has a tab of its own. ``catalog.quick`` makes those that apply.

    Returns:
        The path.

    Raises:
        BadInput: the folder does not exist or cannot be written; maps of different sizes or unknown steps; a diagnostic
            with curves of another number of steps.
    """
    task = find_task(trace.episode.task)
    report = progress or (lambda share: None)
    blocks = _blocks(maps or (), MAPS_PER_CHUNK)
    first = next(blocks, [])
    layers = first[0].layers if first else ()
    sample = thinned(trace)
    layout = blueprint(sample, task, first[0] if first else None, diagnostics)
    bodies = Bodies(sample, task)
    with new_recording(Path(path), sample, bodies, len(trace), layout) as stream:
        for start, last in chunks(len(trace)):
            send_steps(stream, trace, task, bodies, slice(start, last))
            report(0.5 * last / len(trace))
        for name, diagnostic in diagnostics.items():
            log_diagnostic(stream, diagnostic, name, trace)
        if first:
            for entity, what in map_style(first[0], trace):
                stream.log(entity, what, static=True)
        while first:
            _send_maps(stream, first, trace, task, layers)
            report(0.5 + 0.5 * (first[-1].step + 1) / len(trace))
            first = next(blocks, [])
    report(1.0)
    return Path(path)


@contextmanager
def new_recording(
    path: Path, sample: Trace, bodies: Bodies, steps: int, layout: rrb.Blueprint
) -> Iterator[rr.RecordingStream]:
    """A stream into a file that is complete at the end, or not there; its header and what is static are sent.

    Args:
        sample: of the trace's steps, spread over all of them (``thinned``). steps: that the whole trace has.

    Raises BadInput where the folder does not exist or cannot be written.
    """
    rr.set_strict_mode(True)  # or Rerun turns its errors into warnings and leaves gaps
    flush_and_cleanup_orphaned_recordings()  # Rerun keeps each stream there was, with two threads, until it is told
    with _complete_or_absent(path) as unfinished:
        stream = rr.RecordingStream(APPLICATION)
        with let_go(layout):
            stream.save(unfinished, default_blueprint=layout)
        send_header(stream, sample, bodies, steps)
        stream.flush()  # so that even a file cut off later says what it is
        yield stream
        _finish(stream, unfinished)


@contextmanager
def let_go(layout: rrb.Blueprint) -> Iterator[None]:
    """Ends the stream that Rerun makes for a layout and forgets: it holds itself, two threads and what was sent."""
    made, log = [], layout._log_to_stream

    def remembered(stream: rr.RecordingStream) -> None:
        made.append(stream)
        log(stream)

    layout._log_to_stream = remembered  # type: ignore[method-assign]
    try:
        yield
    finally:
        layout._log_to_stream = log  # type: ignore[method-assign]
        for stream in made:
            stream.disconnect()


def chunks(steps: int) -> Iterator[tuple[int, int]]:
    """First step and the one after the last of each part that is sent at once."""
    size = max(STEPS_PER_CHUNK, math.ceil(steps / CHUNKS))
    for first in range(0, steps, size):
        yield first, min(first + size, steps)


def thinned(trace: Trace) -> Trace:
    """Every so many-th of its steps: what the layout and all else that is static is made from, however long it is."""
    stride = thinning(len(trace))
    return trace_of(header_of(trace), {n: a if n in STATIC else a[::stride] for n, a in arrays_of(trace).items()})


def thinning(steps: int) -> int:
    """The stride at which a thousand steps or fewer are left."""
    return max(1, math.ceil(steps / LAYOUT_STEPS))


def stored_arrays(trace: Trace) -> Iterator[tuple[str, bool, NDArray[Any]]]:
    """(path, whether static, array) of every path under ``trace/`` that this trace has something for."""
    of_episode = {field.name for field in fields(Episode)}
    for entity in SCHEMA:
        if entity.archetype == "Trace":
            name = entity.path.removeprefix("trace/")
            array = getattr(trace.episode if name in of_episode else trace, name)
            if array is not None and (array.size or not len(trace)):
                yield entity.path, entity.static, array


def is_picture(array: NDArray[Any]) -> bool:
    """Whether an observation (T, ...) is stored as pictures; all others are stored as scalars."""
    return array.ndim == 3 and array.dtype == np.uint8


def send_header(stream: rr.RecordingStream, trace: Trace, bodies: Bodies, steps: int = GROWING) -> None:
    """The recording's properties, and all else that is not over steps, of a run that these steps are of.

    Args:
        trace: some of its steps. steps: all of them; ``GROWING`` while that is not known.
    """
    _send_properties(stream, trace, steps)
    _send_static(stream, trace, find_task(trace.episode.task), steps)
    for entity, look in bodies.looks():
        stream.log(entity, look, static=True)


def _send_properties(stream: rr.RecordingStream, trace: Trace, steps: int) -> None:
    episode = trace.episode
    arrays = {path: (array if static else array[:1], static) for path, static, array in stored_arrays(trace)}
    shapes = {p: [list(a.shape if static else a.shape[1:]), a.dtype.str] for p, (a, static) in arrays.items()}
    shapes |= {
        f"observations/{key}": [list(array.shape[1:]), array.dtype.str] for key, array in episode.observations.items()
    }
    # What every trace has is said even where it is empty, so that it is read back as such.
    shapes.setdefault("trace/qpos", [list(episode.qpos.shape[1:]), episode.qpos.dtype.str])
    for name in ("modality_mean", "modality_covariance"):
        array = getattr(trace, name)
        shapes.setdefault(f"trace/{name}", [list(array.shape[1:]), array.dtype.str])
    versions = {name: importlib.metadata.version(name) for name in ("rerun-sdk", "numpy")}
    text = json.dumps
    said = {
        "format_version": FORMAT_VERSION,
        "versions": text({"beliefscope": beliefscope.__version__} | versions),
        "task": episode.task,
        "filter": trace.filter,
        "kind": trace.kind,
        "modalities": text(trace.modalities),
        "episode_index": trace.episode_index,
        "steps": steps,
        "dt": float(episode.dt),
        "seed": trace.seed,
        "checkpoint_hash": trace.checkpoint_hash,
        "data_hash": trace.data_hash,
        "faults": text(trace.faults.to_json()),
        "settings": text(dict(trace.settings)),
        "episode": text({"seed": episode.seed, "split": episode.split, "provenance": dict(episode.provenance)}),
        "shapes": text(shapes),
    }
    # As arrays: an empty text of a name that Rerun has not met before would be left out.
    stream.send_property("beliefscope", rr.AnyValues(**{name: pa.array([value]) for name, value in said.items()}))
    stream.send_recording_name(f"{episode.task} {trace.episode_index}, {trace.filter}")


def _send_static(stream: rr.RecordingStream, trace: Trace, task: Task, steps: int) -> None:
    for path, static, array in stored_arrays(trace):
        if static:
            stream.log(path, [_values(array)], static=True)
    for key, array in trace.episode.observations.items():
        if is_picture(array):
            height, width = array.shape[1:]
            gray = rr.components.ImageFormat(width=width, height=height, color_model="L", channel_datatype="U8")
            stream.log(f"observations/{key}", rr.Image.from_fields(format=gray), static=True)
    for path, what in entities.style(trace, task):
        stream.log(path, what, static=True)
    stream.log("about", entities.about(trace, task, steps), static=True)


def send_steps(
    stream: rr.RecordingStream, trace: Trace, task: Task, bodies: Bodies, steps: slice, offset: int = 0
) -> None:
    """Some steps of a trace, stored and drawn.

    Args:
        steps: of the trace, from and to. offset: which step of the run the trace's first is, where it is only a part.
            A part that is not the run's beginning begins at least one step before ``steps``: what changed is told.
    """
    times = entities.time_columns(np.arange(steps.start, steps.stop) + offset, trace.episode.dt)
    for path, static, array in stored_arrays(trace):
        if not static:
            rows = array[steps]
            column = rr.ComponentColumn(TRACE_COMPONENT, _batch(rows), lengths=[rows[0].size] * len(rows))
            stream.send_columns(path, times, [column])
    for key, array in trace.episode.observations.items():
        rows = array[steps]
        columns = (
            rr.Image.columns(buffer=list(rows.reshape(len(rows), -1))) if is_picture(array) else entities.series(rows)
        )
        stream.send_columns(f"observations/{key}", times, columns)
    for path, columns in entities.columns(trace, task, steps):
        stream.send_columns(path, times, columns)
    for path, columns in bodies.columns(trace.episode.qpos[steps]):
        stream.send_columns(path, times, columns)
    changes, states = entities.contact_changes(trace, steps)
    if len(changes):
        stream.send_columns("contact", entities.time_columns(changes + offset, trace.episode.dt), states)


def _send_maps(
    stream: rr.RecordingStream, maps: list[LikelihoodMap], trace: Trace, task: Task, layers: tuple[str, ...]
) -> None:
    for one in maps:
        if not 0 <= one.step < len(trace):
            raise BadInput(f"map of step {one.step}: the trace has steps 0 to {len(trace) - 1}.")
        if one.layers != layers or one.log_likelihood.shape != maps[0].log_likelihood.shape:
            raise BadInput(f"map of step {one.step}: all maps of a recording have one size and one set of layers.")
    times = entities.time_columns(np.array([one.step for one in maps]), trace.episode.dt)
    for path, columns in map_columns(maps, trace, task):
        stream.send_columns(path, times, columns)


def _batch(array: NDArray[Any]) -> AnyBatchValue:
    return AnyBatchValue(TRACE_COMPONENT, pa.array(array.ravel()))


def _values(array: NDArray[Any]) -> Any:
    return rr.DescribedComponentBatch(_batch(array), rr.ComponentDescriptor(TRACE_COMPONENT))


def _blocks(maps: Iterable[LikelihoodMap], size: int) -> Iterator[list[LikelihoodMap]]:
    rest = iter(maps)
    while block := list(islice(rest, size)):
        yield block


_CUT_SHORT = ENOSPC, "Rerun could not write the file to its end"  # it does not say why, and there is hardly another


def _finish(stream: rr.RecordingStream, path: Path) -> None:
    """Writes what is still queued, then asks the file for its footer: Rerun only logs that a disk was full."""
    try:
        stream.flush()
        stream.disconnect()
        RrdReader(path).store()
    except (RuntimeError, ValueError):
        raise OSError(*_CUT_SHORT) from None


@contextmanager
def _complete_or_absent(path: Path) -> Iterator[Path]:
    """A name in the same folder to write under; renamed to ``path`` at the end, removed if anything goes wrong."""
    if not path.parent.is_dir():
        raise BadInput(f"cannot write {path}: the folder {path.parent} does not exist.")
    unfinished = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        try:
            yield unfinished
            os.replace(unfinished, path)
        finally:
            unfinished.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from None
    except UnicodeEncodeError:
        raise BadInput(f"cannot write {str(path)!r}: Rerun writes only to files whose names are text") from None
    except RuntimeError as error:
        if "File-writer" not in str(error):  # Rerun's thread, which ends where it cannot write
            raise
        raise unwritable(path, OSError(*_CUT_SHORT)) from None

"""Writes a trace as a ``.rrd`` recording, atomically: under a temporary name that is renamed at the end."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.any_batch_value import AnyBatchValue
from rerun.chunk import RrdReader
from rerun_bindings import flush_and_cleanup_orphaned_recordings

import beliefscope
from beliefscope.datasets.episode import Episode, is_image
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_error
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import task_to_json
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.trace import Trace, arrays_of, header_of, trace_from_arrays
from beliefscope.inspect.traces.data import STATIC
from beliefscope.recordings.rerun_log import entities
from beliefscope.recordings.rerun_log.blueprint import blueprint
from beliefscope.recordings.rerun_log.bodies import Bodies
from beliefscope.recordings.rerun_log.diagnostics import log_diagnostic
from beliefscope.recordings.rerun_log.maps import map_columns, map_style
from beliefscope.recordings.rerun_log.stream import FileStream, send_layout
from beliefscope.recordings.schema import FORMAT_VERSION, GROWING, SCHEMA, TRACE_COMPONENT

STEPS_PER_CHUNK, CHUNKS = 1000, 100
"""Minimum number of steps per chunk, and maximum number of chunks: Rerun keeps an index of about 0.4 MB per chunk in
memory until the file is complete. Each chunk of an entity has 2 kB of metadata."""

PARTICLES_PER_CHUNK, STEPS_WITH_PARTICLES = 300_000, 100
"""Number of particles over all steps of a chunk (20 MB), and minimum number of its steps."""

MAPS_PER_CHUNK = 100
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
        path: of the ``.rrd`` file. An existing file is replaced once the new one is complete.
        maps: likelihood maps of distinct steps of this trace, all of one size; consumed in blocks, so an iterator may
            compute them on demand. Stored as 8-bit fractions of their layer's maximum, with an error of at most 1/510.
        progress: called with the completed fraction, 0 to 1.
        diagnostics: of this trace, by name; each has a tab. ``catalog.quick`` computes the applicable ones.

    Returns:
        The path.

    Raises:
        BadInput: the folder does not exist or is not writable; maps have different sizes or invalid steps; a
            diagnostic has curves with another number of steps.
    """
    task = trace.task
    report = progress or (lambda fraction: None)
    blocks = _blocks(maps or (), MAPS_PER_CHUNK)
    first = next(blocks, [])
    layers = first[0].layers if first else ()
    sample = thinned(trace)
    layout = blueprint(sample, task, first[0] if first else None, diagnostics)
    bodies = Bodies(sample, task)
    with new_recording(Path(path), sample, bodies, len(trace)) as stream:
        for start, last in chunks(len(trace), steps_per_chunk(trace)):
            send_steps(stream, trace, task, bodies, slice(start, last))
            if start == 0:
                send_layout(stream, layout)
            report(0.5 * last / len(trace))
        for name, diagnostic in diagnostics.items():
            log_diagnostic(stream, diagnostic, name, trace)
        if first:
            for entity, style in map_style(first[0], trace):
                stream.log(entity, style, static=True)
        while first:
            _send_maps(stream, first, trace, task, layers)
            report(0.5 + 0.5 * (first[-1].step + 1) / len(trace))
            first = next(blocks, [])
    report(1.0)
    return Path(path)


@contextmanager
def new_recording(path: Path, sample: Trace, bodies: Bodies, steps: int) -> Iterator[rr.RecordingStream]:
    """Yields a stream to a file written atomically, after sending header and static entities.

    Args:
        sample: steps spread over the whole trace (``thinned``).
        steps: number of steps of the whole trace.

    Raises BadInput if the folder does not exist or is not writable.
    """
    rr.set_strict_mode(True)  # otherwise Rerun turns errors into warnings and writes incomplete data
    flush_and_cleanup_orphaned_recordings()  # Rerun keeps every stream and its two threads until this call
    with _complete_or_absent(path) as unfinished:
        stream = FileStream()
        try:
            stream.save(unfinished)
            send_header(stream, sample, bodies, steps)
            stream.flush()  # so that a truncated file has a header
            yield stream
        finally:
            stream.disconnect()
        RrdReader(unfinished).store()  # checks the footer


def steps_per_chunk(like: Trace) -> int:
    """Minimum number of steps per chunk of a run. like: some of its steps."""
    particles = 1 if like.particles is None else max(1, like.particles.shape[1])
    return min(STEPS_PER_CHUNK, max(STEPS_WITH_PARTICLES, PARTICLES_PER_CHUNK // particles))


def chunks(steps: int, minimum: int = STEPS_PER_CHUNK) -> Iterator[tuple[int, int]]:
    """(first, last + 1) steps of each chunk."""
    size = max(minimum, math.ceil(steps / CHUNKS))
    for first in range(0, steps, size):
        yield first, min(first + size, steps)


def thinned(trace: Trace) -> Trace:
    """At most ``LAYOUT_STEPS`` steps of a trace, from which layout and static entities are computed."""
    stride = thinning(len(trace))
    return trace_from_arrays(
        header_of(trace), {n: a if n in STATIC else a[::stride] for n, a in arrays_of(trace).items()}
    )


def thinning(steps: int) -> int:
    """Stride that leaves at most ``LAYOUT_STEPS`` steps."""
    return max(1, math.ceil(steps / LAYOUT_STEPS))


def stored_arrays(trace: Trace) -> Iterator[tuple[str, bool, NDArray[Any]]]:
    """(path, whether static, array) of every path under ``trace/`` for which the trace has data."""
    episode_fields = {field.name for field in fields(Episode)}
    for entity in SCHEMA:
        if entity.archetype == "Trace":
            name = entity.path.removeprefix("trace/")
            array = getattr(trace.episode if name in episode_fields else trace, name)
            if array is not None and (array.size or not len(trace)):
                yield entity.path, entity.static, array


def send_header(stream: rr.RecordingStream, trace: Trace, bodies: Bodies, steps: int = GROWING) -> None:
    """Send the recording's properties and static entities.

    Args:
        trace: some steps of the run.
        steps: number of all steps; ``GROWING`` if not known yet.
    """
    _send_properties(stream, trace, steps)
    _send_static(stream, trace, trace.task, steps)
    for entity, archetype in bodies.static():
        stream.log(entity, archetype, static=True)


def _send_properties(stream: rr.RecordingStream, trace: Trace, steps: int) -> None:
    episode = trace.episode
    arrays = {path: (array if static else array[:1], static) for path, static, array in stored_arrays(trace)}
    shapes = {p: [list(a.shape if static else a.shape[1:]), a.dtype.str] for p, (a, static) in arrays.items()}
    shapes |= {
        f"observations/{key}": [list(array.shape[1:]), array.dtype.str] for key, array in episode.observations.items()
    }
    shapes |= {f"covariates/{name}": [[], array.dtype.str] for name, array in episode.covariates.items()}
    shapes |= {f"extra/{name}": [[], array.dtype.str] for name, array in trace.extra.items()}
    # Arrays that every trace has are listed even if empty.
    shapes.setdefault("trace/qpos", [list(episode.qpos.shape[1:]), episode.qpos.dtype.str])
    for name in ("modality_mean", "modality_covariance"):
        array = getattr(trace, name)
        shapes.setdefault(f"trace/{name}", [list(array.shape[1:]), array.dtype.str])
    versions = {name: importlib.metadata.version(name) for name in ("rerun-sdk", "numpy")}
    text = json.dumps
    properties = {
        "format_version": FORMAT_VERSION,
        "versions": text({"beliefscope": beliefscope.__version__} | versions),
        "task": episode.task.name,
        "definition": text(task_to_json(episode.task)),
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
    # As arrays, because Rerun omits empty strings of new names.
    values = {name: pa.array([value]) for name, value in properties.items()}
    stream.send_property("beliefscope", rr.AnyValues(**values))
    stream.send_recording_name(f"{episode.task.name} {trace.episode_index}, {trace.filter}")


def _send_static(stream: rr.RecordingStream, trace: Trace, task: Task, steps: int) -> None:
    for path, static, array in stored_arrays(trace):
        if static:
            stream.log(path, [_values(array)], static=True)
    for key, array in trace.episode.observations.items():
        if is_image(array):
            height, width, *channels = array.shape[1:]
            model: Literal["RGB", "L"] = "RGB" if channels else "L"
            pixels = rr.components.ImageFormat(width=width, height=height, color_model=model, channel_datatype="U8")
            stream.log(f"observations/{key}", rr.Image.from_fields(format=pixels), static=True)
    for path, style in entities.style(trace, task):
        stream.log(path, style, static=True)
    stream.log("about", entities.about(trace, task, steps), static=True)


def send_steps(
    stream: rr.RecordingStream, trace: Trace, task: Task, bodies: Bodies, steps: slice, offset: int = 0
) -> None:
    """Send some steps of a trace: stored arrays and display entities.

    Args:
        steps: range of steps in the trace.
        offset: step of the run at which the trace begins, if it is only a part of the run. Such a part must include
            the step before ``steps``, to detect changes of contact.
    """
    times = entities.time_columns(trace.episode, np.arange(steps.start, steps.stop), offset)
    for path, static, array in stored_arrays(trace):
        if not static:
            rows = array[steps]
            column = rr.ComponentColumn(TRACE_COMPONENT, _batch(rows), lengths=[rows[0].size] * len(rows))
            stream.send_columns(path, times, [column])
    for key, array in trace.episode.observations.items():
        rows = array[steps]
        columns = (
            rr.Image.columns(buffer=list(rows.reshape(len(rows), -1))) if is_image(array) else entities.series(rows)
        )
        stream.send_columns(f"observations/{key}", times, columns)
    for name, array in trace.episode.covariates.items():
        stream.send_columns(f"covariates/{name}", times, entities.series(array[steps]))
    for name, array in trace.extra.items():
        stream.send_columns(f"extra/{name}", times, entities.series(array[steps]))
    for path, columns in entities.columns(trace, task, steps):
        stream.send_columns(path, times, columns)
    for path, columns in bodies.columns(trace.episode.qpos[steps]):
        stream.send_columns(path, times, columns)
    changes, states = entities.contact_changes(trace, steps)
    if len(changes):
        stream.send_columns("contact", entities.time_columns(trace.episode, changes, offset), states)


def _send_maps(
    stream: rr.RecordingStream, maps: list[LikelihoodMap], trace: Trace, task: Task, layers: tuple[str, ...]
) -> None:
    for map_ in maps:
        if not 0 <= map_.step < len(trace):
            raise BadInput(f"map of step {map_.step}: the trace has steps 0 to {len(trace) - 1}.")
        if map_.layers != layers or map_.log_likelihood.shape != maps[0].log_likelihood.shape:
            raise BadInput(f"map of step {map_.step}: all maps of a recording must have the same size and layers.")
    times = entities.time_columns(trace.episode, np.array([map_.step for map_ in maps]))
    for path, columns in map_columns(maps, trace, task):
        stream.send_columns(path, times, columns)


def _batch(array: NDArray[Any]) -> AnyBatchValue:
    return AnyBatchValue(TRACE_COMPONENT, pa.array(array.ravel()))


def _values(array: NDArray[Any]) -> Any:
    return rr.DescribedComponentBatch(_batch(array), rr.ComponentDescriptor(TRACE_COMPONENT))


def _blocks(maps: Iterable[LikelihoodMap], size: int) -> Iterator[list[LikelihoodMap]]:
    remaining = iter(maps)
    while block := list(islice(remaining, size)):
        yield block


@contextmanager
def _complete_or_absent(path: Path) -> Iterator[Path]:
    """Yields a temporary path in the same folder; renamed to ``path`` at the end, removed on errors."""
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
        raise write_error(path, error) from None
    except UnicodeEncodeError:
        raise BadInput(f"cannot write {str(path)!r}: Rerun requires file names that are valid text") from None

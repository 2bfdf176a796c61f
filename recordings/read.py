"""Reads the trace in a ``.rrd`` recording with Rerun's reader."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from beliefscope.datasets.catalog import stored_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.file import current_array, current_kind, stored_faults
from beliefscope.inspect.traces.validate import validate_trace
from beliefscope.recordings.rerun_log.metadata import properties_of, reading
from beliefscope.recordings.rerun_log.stream import escaped_path
from beliefscope.recordings.schema import (
    APPLICATION,
    FORMAT_VERSION,
    GROWING,
    HEADER,
    PROPERTIES,
    STEP,
    TRACE_COMPONENT,
)

VALUES = (TRACE_COMPONENT, "Image:buffer", "Scalars:scalars")
STORED = ["/trace/**", "/observations/**", "/covariates/**", "/extra/**", f"/{HEADER}"]


Rows = dict[str, list[tuple[NDArray[np.int64] | None, NDArray[Any]]]]
"""Stored path -> its chunks: steps (R,), None if static, and flattened values."""


def read_recording(path: str | Path, given: Iterable[Task] = ()) -> Trace:
    """Read the trace in a recording, equal to the recorded one in values and types.

    Of a live run that is in progress or was killed, reads the complete steps. Rerun cannot read a file with an
    incomplete last message; in that case, read the ``.live`` file.

    Args:
        given: user-defined tasks, as for ``stored_task``.

    Raises:
        BadInput: the file does not exist, is not a Beliefscope recording, has a newer format version, or is truncated.
    """
    path = Path(path)
    header, rows = _load(path)
    try:
        trace = _trace(path, header, rows, given)
        validate_trace(trace)
    except BadInput as error:
        raise error if str(path) in str(error) else BadInput(f"{path}: {error}") from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, MemoryError, RecursionError) as error:
        raise BadInput(f"{path}: not a complete recording: {' '.join(str(error).split())}") from None
    return trace


def _trace(path: Path, header: dict[str, Any], rows: Rows, given: Iterable[Task]) -> Trace:
    steps, shapes = int(header["steps"]), json.loads(header["shapes"])
    if steps == GROWING:
        steps = _complete(path, shapes, rows)
    arrays = {name: _assemble(path, name, rows[escaped_path(name)], steps, entry) for name, entry in shapes.items()}
    origin, settings = json.loads(header["episode"]), json.loads(header["settings"])
    observations = {
        name.removeprefix("observations/"): array for name, array in arrays.items() if name.startswith("observations/")
    }
    stored: dict[str, Any] = {
        current_array(name.removeprefix("trace/")): a for name, a in arrays.items() if name.startswith("trace/")
    }
    episode_fields = {field.name for field in fields(Episode)} & stored.keys()
    episode = Episode(
        task=stored_task(_parsed(header, "definition").get("definition", header["task"]), given),
        observations=observations,
        covariates={n.removeprefix("covariates/"): a for n, a in arrays.items() if n.startswith("covariates/")},
        dt=float(header["dt"]),
        seed=origin["seed"],
        split=origin["split"],
        provenance=origin["provenance"],
        **{name: stored[name] for name in episode_fields},
    )
    return Trace(
        episode=episode,
        modalities=tuple(json.loads(header["modalities"])),
        kind=current_kind(header["kind"]),
        filter=header["filter"],
        checkpoint_hash=header["checkpoint_hash"],
        data_hash=header["data_hash"],
        episode_index=int(header["episode_index"]),
        seed=int(header["seed"]),
        faults=stored_faults(_parsed(header, "faults", "recipe") | {"settings": settings}),
        settings=settings,
        extra={n.removeprefix("extra/"): a for n, a in arrays.items() if n.startswith("extra/")},
        **{name: stored[name] for name in stored.keys() - episode_fields},
    )


def _parsed(header: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """JSON values of the properties that exist."""
    return {name: json.loads(header[name]) for name in names if name in header}


def _load(path: Path) -> tuple[dict[str, Any], Rows]:
    """Header and stored rows of a file."""
    if not path.is_file():
        raise BadInput(f"{path}: no such file; expected a recording (.rrd).")
    header: dict[str, Any] = {}
    rows: Rows = defaultdict(list)
    with reading(path) as reader:
        stores = [store for store in reader.recordings() if store.application_id == APPLICATION]
        if stores:
            for chunk in reader.stream(store=stores[0]).filter(content=STORED):
                batch = chunk.to_record_batch()
                if chunk.entity_path == f"/{HEADER}":
                    header |= properties_of(batch)
                else:
                    rows[chunk.entity_path.removeprefix("/")] += _values(batch)
    version = header.get("format_version")
    if version is None:
        raise BadInput(
            f"{path}: a Rerun recording, but not written by {APPLICATION}; `import --map` reads it as a log."
        )
    if version != FORMAT_VERSION:
        versions = " ".join(str(header.get("versions", "an unknown version")).split())
        raise BadInput(
            f"{path}: recording format {version}, written by {versions}; this version reads format {FORMAT_VERSION}."
        )
    if missing := PROPERTIES.keys() - header.keys() - {"faults", "definition"}:
        raise BadInput(f"{path}: the recording lacks the properties {', '.join(sorted(missing))}.")
    return header, rows


def _values(batch: pa.RecordBatch) -> list[tuple[NDArray[np.int64] | None, NDArray[Any]]]:
    """Stored values of the batch, if any (styles are in separate batches)."""
    names = batch.schema.names
    steps = batch.column(STEP).to_numpy() if STEP in names else None
    chunks = []
    for name in VALUES:
        if name in names:
            values = batch.column(name)
            while pa.types.is_list(values.type):
                values = values.flatten()
            chunks.append((steps, values.to_numpy(zero_copy_only=False)))
    return chunks


def _complete(path: Path, shapes: dict[str, Any], rows: Rows) -> int:
    """Number of complete steps of an unfinished live run. Drops rows of incomplete steps."""
    over_steps = [escaped_path(name) for name, (shape, _) in shapes.items() if 0 not in shape]
    over_steps = [name for name in over_steps if not rows[name] or any(index is not None for index, _ in rows[name])]
    steps = min(sum(len(index) for index, _ in rows[name] if index is not None) for name in over_steps)
    if not steps:
        raise BadInput(f"{path}: no step is complete.")
    for name in over_steps:
        chunks = [(index, value.reshape(len(index), -1)) for index, value in rows[name] if index is not None]
        rows[name] = [(index[index < steps], value[index < steps].ravel()) for index, value in chunks]
    return steps


def _assemble(
    path: Path, name: str, rows: list[tuple[NDArray[np.int64] | None, NDArray[Any]]], steps: int, entry: list[Any]
) -> NDArray[Any]:
    """One stored array with its rows sorted by step. entry: shape and type from the property ``shapes``."""
    shape, dtype = tuple(entry[0]), np.dtype(entry[1])
    if 0 in shape:
        return np.zeros((steps, *shape), dtype)
    indices = [index for index, _ in rows if index is not None]
    if rows and not indices:
        return rows[0][1].reshape(shape).astype(dtype, copy=False)
    order = np.concatenate([np.zeros(0, np.int64), *indices])
    if not np.array_equal(np.sort(order), np.arange(steps)):
        raise BadInput(f"{path}: {name} has {len(order)} of {steps} steps; the recording is truncated.")
    values = np.concatenate([value for _, value in rows]).reshape(steps, *shape)
    return values[np.argsort(order)].astype(dtype, copy=False)

"""Trace files: safetensors with a JSON header. Loading validates the content and accepts names of earlier versions."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import fields
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from beliefscope.datasets.catalog import stored_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, reason_unreadable
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.io.atomic_write import replacing
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import task_to_json
from beliefscope.inspect.traces.data import ARRAYS, STATIC, Trace, arrays_of
from beliefscope.inspect.traces.validate import validate_trace

FORMAT = 1

_TYPES = {
    "|b1": "BOOL",
    "|u1": "U8",
    "|i1": "I8",
    "<i2": "I16",
    "<u2": "U16",
    "<f2": "F16",
    "<i4": "I32",
    "<u4": "U32",
    "<f4": "F32",
    "<f8": "F64",
    "<i8": "I64",
    "<u8": "U64",
}
"""NumPy's types and their names in safetensors, in the order by which safetensors sorts."""

_RENAMED_ARRAYS = {"acting": "effective_weights"}
_RENAMED_KINDS = {"foreign": "external"}


def save_trace(trace: Trace, path: Path) -> None:
    """Write a trace atomically. Raises BadInput if the folder does not exist."""
    save_trace_parts([trace], len(trace), path)


def save_trace_parts(parts: Iterable[Trace], steps: int, path: Path) -> Trace:
    """Write consecutive parts of a trace as ``save_trace`` writes the whole, with one part in memory at a time.

    Args:
        steps: number of all steps.

    Returns:
        The first part.

    Raises:
        BadInput: the folder does not exist.
    """
    remaining = iter(parts)
    first = next(remaining)
    arrays = arrays_of(first)
    shapes = {
        name: (*([] if name in STATIC else [steps]), *a.shape[name not in STATIC :]) for name, a in arrays.items()
    }
    header, offsets = _layout({name: (array.dtype, shapes[name]) for name, array in arrays.items()}, header_of(first))
    written = 0
    with replacing(path) as file:
        file.write(header)
        for part in chain([first], remaining):
            for name, array in arrays_of(part).items():
                if name not in STATIC or not written:
                    file.seek(offsets[name] + written * (array.nbytes // max(1, len(array))))
                    file.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
            written += len(part)
        assert written == steps, (written, steps)
    return first


def _layout(
    arrays: Mapping[str, tuple[np.dtype[Any], tuple[int, ...]]], header: Mapping[str, Any]
) -> tuple[bytes, dict[str, int]]:
    """Beginning of a safetensors file, and the offset of each array in it. arrays: type and shape.

    Arrays are sorted as by the package safetensors, which cannot write in parts.
    """
    entries: dict[str, Any] = {"__metadata__": {"beliefscope-trace": json.dumps(header)}}
    end, offsets = 0, {}
    for name in sorted(arrays, key=lambda name: (-list(_TYPES).index(arrays[name][0].str), name)):
        dtype, shape = arrays[name]
        offsets[name], end = end, end + dtype.itemsize * math.prod(shape)
        entries[name] = {"dtype": _TYPES[dtype.str], "shape": shape, "data_offsets": [offsets[name], end]}
    text = json.dumps(entries, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    start = 8 + len(text)
    return struct.pack("<Q", len(text)) + text, {name: start + offset for name, offset in offsets.items()}


def header_of(trace: Trace) -> dict[str, Any]:
    """All fields of a trace except the arrays, as JSON values."""
    episode = trace.episode
    separate = (*ARRAYS, "extra", "episode", "faults", "settings")
    return {
        "format": FORMAT,
        **{f.name: getattr(trace, f.name) for f in fields(Trace) if f.name not in separate},
        "faults": trace.faults.to_json(),
        "settings": dict(trace.settings),
        "episode": {
            "task": task_to_json(episode.task),
            "dt": episode.dt,
            "seed": episode.seed,
            "split": episode.split,
            "provenance": dict(episode.provenance),
        },
    }


def load_trace(path: Path, given: Iterable[Task] = ()) -> Trace:
    """Read a trace. Raises BadInput if the file is missing, truncated or not a trace.

    Args:
        given: user-defined tasks, as for ``stored_task``.
    """
    path = Path(path)
    if not path.is_file():
        problem = f"is a folder; give its traces, such as {path}/*.trace" if path.is_dir() else "does not exist"
        raise BadInput(f"trace {str(path)!r} {problem}")
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
        header = read_json(metadata.get("beliefscope-trace", "null"))
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as error:
        raise BadInput(f"{str(path)!r} is not a readable trace: {reason_unreadable(path, error)}") from None
    if not isinstance(header, dict):
        raise BadInput(f"{str(path)!r} is a safetensors file, but not a Beliefscope trace")
    if (version := header.pop("format", None)) != FORMAT:
        raise BadInput(f"{str(path)!r} has trace format {version!r}; this version reads format {FORMAT}")
    try:
        return trace_from_arrays(header, arrays, given)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{str(path)!r} is not a complete trace: {error}") from None


def trace_from_arrays(header: Mapping[str, Any], arrays: Mapping[str, Any], given: Iterable[Task] = ()) -> Trace:
    """Inverse of ``header_of`` and ``arrays_of``.

    Raises AttributeError, KeyError, TypeError or ValueError (including BadInput) for inconsistent content.
    """
    episode_arrays, origin = _group(arrays, "episode/"), header["episode"]
    episode = Episode(
        **origin | {"task": stored_task(origin["task"], given)},
        **{name: episode_arrays[name] for name in ("states", "controls", "contact", "qpos")},
        observations=_group(episode_arrays, "observations/"),
        covariates=_group(episode_arrays, "covariates/"),
        time=episode_arrays.get("time"),
    )
    values = {name: value for name, value in header.items() if name not in ("format", "episode", "recipe")}
    values |= {
        "modalities": tuple(values["modalities"]),
        "kind": current_kind(values["kind"]),
        "faults": stored_faults(header),
    }
    own_arrays = {current_array(n): a for n, a in arrays.items() if not n.startswith(("episode/", "extra/"))}
    trace = Trace(**values, episode=episode, extra=_group(arrays, "extra/"), **own_arrays)
    validate_trace(trace)
    return trace


def _group(arrays: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """The arrays whose names have a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}


def stored_faults(header: Mapping[str, Any]) -> Faults:
    """Faults of a stored header; earlier versions wrote ``recipe``, or a blackout probability in the settings."""
    faults = header.get("faults", header.get("recipe"))
    if faults is None and (blackout := header["settings"].get("blackout")):
        faults = {"blackout": blackout}
    return Faults.from_json(faults or [])


def current_array(stored: str) -> str:
    """Current name of a stored trace array."""
    return _RENAMED_ARRAYS.get(stored, stored)


def current_kind(stored: Any) -> Any:
    """Current name of a stored kind of filter; other values are returned unchanged and fail validation."""
    return _RENAMED_KINDS.get(stored, stored) if isinstance(stored, str) else stored

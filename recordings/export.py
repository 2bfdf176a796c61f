"""Export of a trace: Parquet for pandas and similar tools, MCAP for Foxglove, npz for NumPy."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from beliefscope.datasets.episode import is_image
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.trace import Trace, arrays_of, header_of
from beliefscope.recordings.rerun_log.columns import Column, columns
from beliefscope.recordings.rerun_log.entities import plane_height

NAME = "beliefscope"
"""Key of everything but the arrays: in Parquet's and MCAP's metadata, and in the npz."""


def export_trace(trace: Trace, path: Path) -> None:
    """Write a trace in the format of the path's suffix: ``.parquet``, ``.mcap`` or ``.npz`` (docs/recordings.md).

    Raises BadInput for another suffix, a missing folder, and if the package for MCAP is not installed.
    """
    write_atomically(path, FORMATS[export_format(path)](trace))


def export_format(path: Path) -> str:
    """``parquet``, ``mcap`` or ``npz``. Raises BadInput for another suffix or if the package is not installed."""
    suffix = path.suffix.removeprefix(".").lower()
    check_name("export format", suffix, FORMATS)
    if suffix == "mcap":
        try:
            import mcap  # noqa: F401
        except ImportError:
            raise BadInput("MCAP export needs the package mcap: pip install 'beliefscope[export]'") from None
    return suffix


def metadata(trace: Trace) -> dict[str, Any]:
    """Everything in a trace except arrays over steps, as JSON values."""
    start = {name: as_json(getattr(trace, name)) for name in ("start_mean", "start_covariance")}
    return header_of(trace) | start | {"steps": len(trace)}


def as_npz(trace: Trace) -> bytes:
    """Every array by name, and the metadata as JSON in the array ``beliefscope``; readable without pickle."""
    data = io.BytesIO()
    arrays: dict[str, Any] = {NAME: np.array(json.dumps(header_of(trace))), **arrays_of(trace)}
    np.savez_compressed(data, **arrays)
    return data.getvalue()


def as_parquet(trace: Trace) -> bytes:
    """One row per step; one column per number by component and modality, and list columns for larger arrays."""
    steps = np.arange(len(trace))
    fields = [pa.field("step", pa.int64()), pa.field("time", pa.float64(), metadata={"unit": "s"})]
    arrays = [pa.array(steps), pa.array(trace.episode.times)]
    for column in columns(trace):
        values = pa.array(np.ascontiguousarray(column.values).ravel())
        if column.values.ndim > 1:
            values = pa.FixedSizeListArray.from_arrays(values, column.values.shape[1])
        arrays.append(values)
        shape = {"shape": ",".join(map(str, column.shape))} if len(column.shape) > 1 else {}
        fields.append(pa.field(column.name, values.type, metadata={"unit": column.unit} | shape))
    schema = pa.schema(fields, metadata={NAME: json.dumps(metadata(trace))})
    data = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), data, compression="zstd")
    return data.getvalue()


def as_mcap(trace: Trace) -> bytes:
    """One topic per array and observation with JSON messages; images and particles in Foxglove's schemas."""
    from mcap.writer import Writer

    file = io.BytesIO()
    writer = Writer(file)
    writer.start(library=NAME)
    writer.add_metadata(NAME, {"trace": json.dumps(metadata(trace))})
    topics = dict(_topics(trace))
    channels = {}
    for topic, (schema, _) in topics.items():
        id = writer.register_schema(schema["title"], encoding="jsonschema", data=json.dumps(schema).encode())
        channels[topic] = writer.register_channel(topic, "json", id)
    for step in range(len(trace)):
        time = round(trace.episode.times[step] * 1e9)
        for topic, (_, message) in topics.items():
            data = json.dumps(message(step), allow_nan=False).encode()
            writer.add_message(channels[topic], log_time=time, data=data, publish_time=time, sequence=step)
    writer.finish()
    return file.getvalue()


FORMATS: dict[str, Callable[[Trace], bytes]] = {"parquet": as_parquet, "mcap": as_mcap, "npz": as_npz}
"""Suffix of a file -> its contents."""

Topics = list[tuple[str, tuple[dict[str, Any], Callable[[int], dict[str, Any]]]]]
"""Topic -> JSON schema, and the message of a step."""

TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
BYTES = {"type": "string", "contentEncoding": "base64"}
FLOAT32 = 7
"""Foxglove's code of the type in the fields of a point cloud."""


def _topics(trace: Trace) -> Topics:
    arrays: dict[str, list[Column]] = {}
    topics: Topics = []
    for column in columns(trace):
        if column.group == "observations" and _encoding(trace.episode.observations[column.parts[0]]):
            topics.append((f"/observations/{column.parts[0]}", _images(column, trace)))
        else:
            arrays.setdefault(f"/{column.group}/{column.parts[0]}", []).append(column)
    topics += [(topic, _numbers(topic, group)) for topic, group in arrays.items()]
    if trace.particles is not None and trace.log_weights is not None and trace.task.floor is not None:
        topics.append(("/particles", _particles(trace)))
    return topics


def _numbers(topic: str, group: list[Column]) -> tuple[dict[str, Any], Callable[[int], dict[str, Any]]]:
    """``{"image": {"hinge_x": 0.8}}``, or ``{"value": ..}`` for an array without parts. Non-finite values are null."""
    schema: dict[str, Any] = {"title": f"{NAME}{topic.replace('/', '.')}", "type": "object", "properties": {}}
    values: list[tuple[tuple[str, ...], list[Any]]] = []
    for column in group:
        path = column.parts[1:] or ("value",)
        kind: dict[str, Any] = {"type": "boolean" if column.values.dtype == bool else "number"}
        kind = {"type": "array", "items": kind} if column.values.ndim > 1 else kind
        inner = schema
        for part in path:
            inner = inner["properties"].setdefault(part, {"type": "object", "properties": {}})
        inner.clear()
        inner.update(kind | ({"description": column.unit} if column.unit else {}))
        values.append((path, as_json(column.values)))

    def message(step: int) -> dict[str, Any]:
        document: dict[str, Any] = {}
        for path, rows in values:
            inner = document
            for part in path[:-1]:
                inner = inner.setdefault(part, {})
            inner[path[-1]] = rows[step]
        return document

    return schema, message


def _encoding(readings: NDArray[Any]) -> str:
    """Encoding of images (T, ...) in Foxglove's schema: gray, RGB, or float32 with one channel; else empty."""
    if is_image(readings):
        return "rgb8" if readings.ndim == 4 else "mono8"
    return "32FC1" if readings.dtype == np.float32 and readings.ndim == 3 else ""


def _images(column: Column, trace: Trace) -> tuple[dict[str, Any], Callable[[int], dict[str, Any]]]:
    height, width, *channels = column.shape
    readings = trace.episode.observations[column.parts[0]]
    numbers = {name: {"type": "integer"} for name in ("width", "height", "step")}
    texts = {name: {"type": "string"} for name in ("frame_id", "encoding")}
    schema = _schema("foxglove.RawImage", {"timestamp": TIME, **texts, **numbers, "data": BYTES})

    def message(step: int) -> dict[str, Any]:
        return {
            "timestamp": _time(step, trace),
            "frame_id": column.parts[0],
            "encoding": _encoding(readings),
            "width": width,
            "height": height,
            "step": width * (channels[0] if channels else 1) * readings.itemsize,
            "data": _packed(column.values[step]),
        }

    return schema, message


def _particles(trace: Trace) -> tuple[dict[str, Any], Callable[[int], dict[str, Any]]]:
    """Predicted particles on the plane of the map, and their weights after the observation, before resampling."""
    assert trace.particles is not None
    assert trace.log_weights is not None
    task = trace.task
    assert task.floor is not None
    places = trace.particles[..., list(task.floor)]
    height = np.full_like(places[..., :1], plane_height(trace, task))
    points = np.concatenate([places, height, np.exp(trace.log_weights)[..., None]], axis=-1, dtype=np.float32)
    fields = [{"name": name, "offset": 4 * i, "type": FLOAT32} for i, name in enumerate(("x", "y", "z", "weight"))]
    zero, none = dict.fromkeys("xyz", 0.0), {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    number = {"type": "number"}
    three, four = (_object(dict.fromkeys(names, number)) for names in ("xyz", "xyzw"))
    field = _object({"name": {"type": "string"}, "offset": {"type": "integer"}, "type": {"type": "integer"}})
    schema = _schema(
        "foxglove.PointCloud",
        {
            "timestamp": TIME,
            "frame_id": {"type": "string"},
            "pose": _object({"position": three, "orientation": four}),
            "point_stride": {"type": "integer"},
            "fields": {"type": "array", "items": field},
            "data": BYTES,
        },
    )

    def message(step: int) -> dict[str, Any]:
        return {
            "timestamp": _time(step, trace),
            "frame_id": "world",
            "pose": {"position": zero, "orientation": none},
            "point_stride": 16,
            "fields": fields,
            "data": _packed(points[step]),
        }

    return schema, message


def _schema(title: str, properties: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, **_object(properties)}


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _time(step: int, trace: Trace) -> dict[str, int]:
    sec, nsec = divmod(round(trace.episode.times[step] * 1e9), 1_000_000_000)
    return {"sec": sec, "nsec": nsec}


def _packed(array: NDArray[Any]) -> str:
    """Little endian, base64."""
    return base64.b64encode(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()).decode()

"""Rerun recordings of other programs: scalars, vectors, tensors, images and text on a timeline.

A topic is an entity, or an entity and a component, ``/robot.translation``, if it has several.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from pyarrow import compute

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.recordings.log_readers.arrays import check_size
from beliefscope.recordings.log_readers.images import channels, decoded
from beliefscope.recordings.log_readers.tables import from_arrow
from beliefscope.recordings.probe import RecordingProbe
from beliefscope.recordings.rerun_log.metadata import reading

RAW_IMAGES = {"Image:buffer": "Image:format", "DepthImage:buffer": "DepthImage:format"}
"""Component of the pixels -> component of their format."""

AUTOMATIC = ("log_time", "log_tick")
"""Timelines of every recording."""


@contextmanager
def open_log(path: Path, timeline: str | None) -> Iterator[RerunLog]:
    """The first recording of a file. A separate process reads the file first, because Rerun may crash.

    timeline: its name; if empty, the only one besides ``AUTOMATIC``, else ``log_time``; None takes the first.

    Raises BadInput for a damaged file, one without a recording, and a timeline that is unknown or ambiguous.
    """
    info = RecordingProbe()(path)
    if info.problem and not info.application:
        raise BadInput(info.problem)
    with reading(path) as reader:
        store = next(iter(reader.recordings()), None)
        if store is None:
            raise BadInput("the file has no recording")
        batches = [chunk.to_record_batch() for chunk in reader.stream(store=store)]
        for batch in batches:
            batch.validate(full=True)  # offsets outside of a damaged array would be read
        yield RerunLog.from_batches(batches, timeline)


@dataclass(frozen=True)
class Part:
    """A component of an entity in one chunk: times (R,), decoder of a row, rows with a value."""

    times: NDArray[np.int64]
    decode: Callable[[int], Any]
    rows: NDArray[np.intp]


@dataclass
class RerunLog:
    """An open recording. parts: topic -> its chunks."""

    parts: Mapping[str, Sequence[Part]]
    second: float | None
    timeline: str

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics."""
        return tuple(sorted(self.parts))

    @classmethod
    def from_batches(cls, batches: Sequence[pa.RecordBatch], timeline: str | None) -> RerunLog:
        """The components in the chunks of a recording. timeline, errors: as for ``open_log``."""
        indices = {f.name: f.type for batch in batches for f in _fields(batch, b"index")}
        own = sorted(indices.keys() - {*AUTOMATIC}, key=lambda name: (pa.types.is_int64(indices[name]), name))
        if not timeline:
            if len(own) > 1 and timeline is not None:
                raise BadInput(f'the recording has the timelines {", ".join(own)}: add time = "{own[0]}" to the map')
            timeline = own[0] if own else AUTOMATIC[0]
        check_name("timeline", timeline, sorted(indices))
        formats = {(_entity(b), f.name): b.column(f.name) for b in batches for f in _fields(b, b"data")}
        entities: dict[str, dict[str, list[Part]]] = defaultdict(lambda: defaultdict(list))
        for batch in batches:
            if timeline not in batch.schema.names or _entity(batch).startswith("/__"):
                continue
            times = batch.column(timeline).cast(pa.int64()).to_numpy()
            for field in _fields(batch, b"data"):
                column = batch.column(field.name)
                stored = formats.get((_entity(batch), RAW_IMAGES.get(field.name, "")))
                if (decode := _decoder(field.name, column, batch, stored)) is not None:
                    filled = np.flatnonzero(compute.fill_null(compute.list_value_length(column), 0).to_numpy())
                    name = field.name.rpartition(":")[2]
                    entities[_entity(batch)][name].append(Part(times, decode, filled))
        parts = {
            entity if len(components) == 1 else f"{entity}.{name}": chunks
            for entity, components in entities.items()
            for name, chunks in components.items()
        }
        second = None if pa.types.is_int64(indices[timeline]) else 1e9
        return cls(parts, second, timeline if len(own) > 1 else "")

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """Topic, time (ns, or number of a step) and decoder of each row with a value, by topic and chunk."""
        for topic in topics:
            for part in self.parts[topic]:
                for row in part.rows.tolist():
                    yield topic, int(part.times[row]), partial(part.decode, row)


def _fields(batch: pa.RecordBatch, kind: bytes) -> list[pa.Field]:
    return [f for f in batch.schema if (f.metadata or {}).get(b"rerun:kind") == kind]


def _entity(batch: pa.RecordBatch) -> str:
    return (batch.schema.metadata or {}).get(b"rerun:entity_path", b"").decode()


def _decoder(name: str, column: Any, batch: pa.RecordBatch, stored: Any) -> Callable[[int], Any] | None:
    """Function from a row to its value; None for a component without numbers, text or images."""
    if name in RAW_IMAGES:
        own = batch.column(RAW_IMAGES[name]) if RAW_IMAGES[name] in batch.schema.names else None
        return lambda row: _image(column[row], own[row] if own is not None and own[row].is_valid else stored[0])
    if name == "EncodedImage:blob":
        return lambda row: decoded(column[row].values[0].values.to_numpy().tobytes())
    if name == "Tensor:data":
        return lambda row: _tensor(column[row].values)
    kind = column.type.value_type if pa.types.is_list(column.type) else pa.null()
    inner = kind.value_type if pa.types.is_fixed_size_list(kind) else kind
    is_value = pa.types.is_primitive(inner) or pa.types.is_string(inner)
    return (lambda row: _value(from_arrow(column[row].values))) if is_value else None


def _value(values: NDArray[Any]) -> NDArray[Any]:
    """The value of a row; the only instance of a component without its axis."""
    return values[0] if len(values) == 1 else values


def _image(pixels: Any, format_: Any) -> NDArray[Any]:
    entry = format_.values[0].as_py()
    if entry["pixel_format"] is not None:
        raise BadInput(f"an image has Rerun's pixel format {entry['pixel_format']}, expected RGB, BGR or one channel")
    model = rr.ColorModel(entry["color_model"] or rr.ColorModel.L)
    type_ = rr.ChannelDatatype(entry["channel_datatype"] or rr.ChannelDatatype.U8).name
    kind = np.dtype(f"{type_[0].lower()}{int(type_[1:]) // 8}")
    shape = (entry["height"], entry["width"], model.num_channels())
    check_size("image", shape, kind)
    data = pixels.values[0].values.to_numpy().view(kind)
    image = data.reshape(shape)
    return channels(image[:, :, [2, 1, 0]] if model in (rr.ColorModel.BGR, rr.ColorModel.BGRA) else image)


def _tensor(cell: Any) -> NDArray[Any]:
    shape = cell.field("shape")[0].as_py()
    return cell.field("buffer")[0].value.values.to_numpy().reshape(shape)

"""LeRobot data sets, version 3: Parquet tables of frames, and videos of the cameras.

The layout is that of https://huggingface.co/docs/lerobot/lerobot-dataset-v3: ``meta/info.json``, ``meta/episodes/``,
``data/chunk-*/file-*.parquet`` and ``videos/CAMERA/chunk-*/file-*.mp4``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import time_error
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.recordings.log_readers.arrays import Wanted, check_downloaded, check_size, unread
from beliefscope.recordings.log_readers.images import decoded
from beliefscope.recordings.log_readers.tables import from_arrow

VERSION = "v3."
LARGEST_INDEX = 10**6

INFO = {
    "codebase_version": ((str,), "a text such as v3.0"),
    "fps": ((int, float), "a number above 0"),
    "features": ((dict,), "a table"),
}
"""Key of the metadata -> its types, and what is expected."""


def read(path: Path, wanted: Wanted) -> dict[str, NDArray[Any]]:
    """The features of all frames, in the order of the files; cameras are (T, H, W, 3) bytes.

    Raises BadInput for another version, missing files, and frames that the videos do not have.
    """
    info = _info(path / "meta" / "info.json")
    features, fps = info["features"], float(info["fps"])
    if not str(info["codebase_version"]).startswith(VERSION):
        raise BadInput(f"the data set has the version {info['codebase_version']!r:.50}, expected v3: convert it first")
    if not 0.0 < fps < 1e6:
        raise BadInput(f"fps in info.json is {fps}, expected a number above 0")
    table = _table(path / "data")
    total = info.get("total_frames", table.num_rows)
    if total != table.num_rows:
        raise BadInput(
            f"data has {table.num_rows} frames and info.json {total!r:.20}, expected the same: download the missing "
            "files, or correct total_frames"
        )
    columns = {name: _column(table.column(name), name, wanted(name)) for name in table.column_names}
    for name, feature in features.items():
        if feature["dtype"] == "video":
            shape = (table.num_rows, *_size(name, feature), 3)
            columns[name] = _Videos(path, name, fps).frames(columns, shape) if wanted(name) else unread(shape, "u1")
    return columns


def _info(path: Path) -> Mapping[str, Any]:
    """The metadata. Raises BadInput for damaged ones and those without a key."""
    try:
        info = read_json(path.read_bytes())
    except ValueError as error:
        raise BadInput(f"meta/{path.name} is damaged: {error!s:.150}") from None
    entries = info if isinstance(info, dict) else {}
    for key, (kinds, expected) in INFO.items():
        if type(value := entries.get(key)) not in kinds:
            raise BadInput(f"{key} in {path.name} is {value!r:.50}, expected {expected}")
    for name, feature in entries["features"].items():
        if not isinstance(feature, dict) or "dtype" not in feature:
            raise BadInput(
                f"feature {name!r:.50} in {path.name} is {feature!r:.50}, expected a table with dtype and shape"
            )
    return entries


def _table(folder: Path) -> Any:
    """All Parquet files of a folder, in the order of their numbers."""
    import pyarrow as pa
    from pyarrow import parquet

    files = sorted(folder.glob("chunk-*/file-*.parquet"), key=lambda file: (len(file.parent.name), file))
    if not files:
        raise BadInput(f"{folder.name} has no chunk-*/file-*.parquet")
    tables = []
    for file in files:
        check_downloaded(file)
        tables.append(parquet.ParquetFile(file).read())
        schemas = [{f"{field.name}: {field.type}" for field in table.schema} for table in (tables[0], tables[-1])]
        if different := schemas[0] ^ schemas[1]:
            name = file.relative_to(folder).as_posix()
            raise BadInput(f"{name} has other columns than the first file: {', '.join(sorted(different)):.150}")
    return pa.concat_tables(tables)


def _column(column: Any, name: str, wanted: bool) -> NDArray[Any]:
    import pyarrow as pa

    if not pa.types.is_struct(column.type):
        return from_arrow(column)
    if not wanted or not len(column):  # images: bytes of PNG or JPEG
        return unread((len(column), 1, 1, 3), "u1")
    first = _decoded(column[0])
    check_size(name, (len(column), *first.shape), first.dtype)
    images = np.zeros((len(column), *first.shape), first.dtype)
    for row, cell in enumerate(column):
        image = _decoded(cell)
        if image.shape != first.shape:
            raise BadInput(f"image {row} of {name!r} has shape {image.shape}, the first {first.shape}")
        images[row] = image
    return images


def _decoded(cell: Any) -> NDArray[np.uint8]:
    content = cell.as_py()["bytes"]
    if not isinstance(content, bytes):
        raise BadInput("an image is not stored in the table, expected its bytes")
    return decoded(content)


def _size(name: str, feature: Mapping[str, Any]) -> tuple[int, int]:
    """Height and width of a camera, whose channels are first or last."""
    shape = feature["shape"]
    if not (len(shape) == 3 and 3 in shape and all(type(size) is int and 0 < size < 1 << 16 for size in shape)):
        raise BadInput(f"camera {name!r} has shape {shape!r:.100}, expected (height, width, 3)")
    return tuple(shape[:2]) if shape[2] == 3 else tuple(shape[1:])


class _Videos:
    """Videos of a camera. Each file has the frames of several episodes."""

    def __init__(self, path: Path, camera: str, fps: float) -> None:
        self.path, self.camera, self.fps = path, camera, fps

    def frames(self, columns: Mapping[str, NDArray[Any]], shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """(T, H, W, 3) frames at the timestamps of the rows. shape: that of the result.

        Raises BadInput for invalid indices of files, invalid timestamps, a missing file or frame, more bytes than
        ``MAX_BYTES``, and without the package av.
        """
        check_size(self.camera, shape, np.uint8)
        frames = np.zeros(shape, np.uint8)
        episodes, times = columns["episode_index"], columns["timestamp"]
        wanted: dict[tuple[int, int], dict[int, int]] = {}
        for entry in _table(self.path / "meta" / "episodes").to_pylist():
            chunk, file, start = (
                entry[f"videos/{self.camera}/{key}"] for key in ("chunk_index", "file_index", "from_timestamp")
            )
            if not (type(chunk) is type(file) is int and 0 <= chunk < LARGEST_INDEX and 0 <= file < LARGEST_INDEX):
                raise BadInput(f"video of {self.camera!r} has the numbers {chunk!r:.20} and {file!r:.20}")
            rows = np.flatnonzero(episodes == entry["episode_index"])
            if error := time_error(times[rows]):
                raise BadInput(f"timestamp of episode {entry['episode_index']} {error}")
            numbers = np.rint((start + times[rows]) * self.fps).astype(np.int64)
            wanted.setdefault((chunk, file), {}).update(zip(numbers.tolist(), rows.tolist(), strict=True))
        missing = set(range(len(frames))) - {row for rows in wanted.values() for row in rows.values()}
        if missing:
            raise BadInput(f"camera {self.camera!r} has no video of row {min(missing)}")
        for (chunk, file), numbered in wanted.items():
            name = f"videos/{self.camera}/chunk-{chunk:03d}/file-{file:03d}.mp4"
            self._decode(name, numbered, frames)
        return frames

    def _decode(self, name: str, rows: Mapping[int, int], frames: NDArray[np.uint8]) -> None:
        """Copy the frames of a file. rows: number of a frame -> row."""
        try:
            import av
        except ImportError:
            raise BadInput(
                f"videos of {self.camera!r} need the package av: pip install 'beliefscope[video]', or leave the camera "
                "out of the map"
            ) from None
        left = dict(rows)
        if not (self.path / name).is_file():
            raise BadInput(f"{name} does not exist")
        check_downloaded(self.path / name)
        with av.open(str(self.path / name)) as container:
            for frame in container.decode(video=0):
                row = left.pop(round(float(frame.time or 0.0) * self.fps), None)
                if row is not None:
                    if (frame.height, frame.width) != frames.shape[1:3]:
                        raise BadInput(
                            f"{name} has frames of {frame.width} x {frame.height} pixels, not {frames.shape}"
                        )
                    frames[row] = frame.to_ndarray(format="rgb24")
                if not left:
                    return
        raise BadInput(f"{name} has no frame at {min(left) / self.fps:.6g} s")

"""Zarr replay buffers: arrays over the steps of all episodes in ``data``, and the episodes' ends in ``meta``."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers.arrays import Wanted, check_size, unread

DATA = "data/"

ENDS = "meta/episode_ends"

METADATA = (".zarray", "zarr.json")
"""Files with the metadata of an array, of format 2 and 3."""

EPISODE = "episode"
"""Column with the number of the episode, from its ends."""

DOCUMENTS = (*METADATA, ".zattrs", ".zgroup")

BLOSC = ("Blosc", "BloscCodec")
"""Compressor in format 2 and 3. It reads beyond the end of a chunk that is shorter than its header states."""

REFUSED = ("pickle", "json2", "msgpack2")
"""Codecs of objects. Reading the first can run code."""


def read(path: Path, wanted: Wanted) -> dict[str, NDArray[Any]]:
    """The arrays of a folder or zip archive in format 2 or 3. Raises BadInput for another layout and other types."""
    import zarr

    if path.is_file() and not zipfile.is_zipfile(path):
        raise BadInput(f"{path.name} is not a complete zip archive")
    names = _nodes(path)
    if ENDS not in names:
        raise BadInput(f"the store has no array {ENDS!r}: not a replay buffer{_elsewhere(path)}")
    storage = zarr.storage
    store = storage.ZipStore(path, mode="r") if path.is_file() else storage.LocalStore(path, read_only=True)
    with closing(store), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about unknown files
        nodes = {name: zarr.open(store, path=name, mode="r") for name in names}
        arrays = {name: node for name, node in nodes.items() if isinstance(node, zarr.Array)}
        if ENDS not in arrays:
            raise BadInput(f"the store has no array {ENDS!r}: not a replay buffer")
        ends = _values(path, ENDS, arrays.pop(ENDS), True)
        if ends.ndim != 1 or ends.dtype.kind not in "iu" or not len(ends) or not _ascends(ends):
            text = f"{ends.dtype} {ends.ravel()[:9].tolist()}"
            raise BadInput(f"{ENDS} is {text}, expected ascending whole numbers, the first above 0")
        columns = {}
        for node, array in arrays.items():
            name = node.removeprefix(DATA)
            if array.shape[:1] != (ends[-1],):
                raise BadInput(f"array {name!r} has shape {array.shape}, and the last episode ends at {ends[-1]}")
            columns[name] = _values(path, node, array, wanted(name))
    check_size(EPISODE, (ends[-1],), np.int64)
    return {EPISODE: np.repeat(np.arange(len(ends)), np.diff(ends, prepend=0))} | columns


def _ascends(ends: NDArray[Any]) -> bool:
    """Whether whole numbers above 0 ascend; differences of damaged ones could overflow."""
    return bool(ends[0] > 0 and np.all(ends[1:] > ends[:-1]))


def _nodes(path: Path) -> list[str]:
    """Paths of the arrays and groups in ``data``, and of the episodes' ends."""
    return sorted(node for node in _all_nodes(path) if node.startswith(DATA) or node == ENDS)


def _all_nodes(path: Path) -> set[str]:
    if path.is_file():
        with zipfile.ZipFile(path) as archive:
            files = archive.namelist()
    else:
        files = [file.relative_to(path).as_posix() for file in path.rglob("*") if file.name in METADATA]
    return {file.rpartition("/")[0] for file in files if file.endswith(METADATA)}


def _elsewhere(path: Path) -> str:
    """Where the episodes' ends are in an archive or folder of a whole store."""
    places = sorted(node for node in _all_nodes(path) if node.endswith(f"/{ENDS}"))
    return f"; it is in the folder {places[0].removesuffix(f'/{ENDS}')!r}, expected at the top" if places else ""


def _values(path: Path, node: str, array: Any, wanted: bool) -> NDArray[Any]:
    name = node.removeprefix(DATA)
    codecs = {str(getattr(codec, "codec_id", "")) for codec in (*array.filters, *array.compressors)}
    if array.dtype.kind not in "fiub" or codecs & {*REFUSED}:
        raise BadInput(f"array {name!r} has the type {array.dtype}, expected numbers")
    if not wanted:
        return unread(array.shape, array.dtype)
    check_size(name, array.shape, array.dtype)
    check_size(f"chunk of {name}", array.chunks, array.dtype)
    if array.compressors and type(array.compressors[-1]).__name__ in BLOSC and array.shards is None:
        for chunk, header, size in _chunks(path, node):
            stored = int.from_bytes(header[12:16], "little")
            if stored != size:
                raise BadInput(f"chunk {chunk} has {size} bytes, and {stored} according to its header: it is damaged")
    return np.asarray(array[...])


def _chunks(path: Path, node: str) -> Iterator[tuple[str, bytes, int]]:
    """Name, first bytes and length of the chunks of an array."""
    if path.is_file():
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                if entry.filename.startswith(f"{node}/") and not entry.filename.endswith(DOCUMENTS):
                    with archive.open(entry) as stream:
                        yield entry.filename, stream.read(16), entry.file_size
    else:
        for file in sorted((path / node).rglob("*")):
            if file.is_file() and not file.name.endswith(DOCUMENTS):
                with file.open("rb") as stream:
                    yield file.relative_to(path).as_posix(), stream.read(16), file.stat().st_size

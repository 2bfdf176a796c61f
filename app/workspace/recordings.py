"""The ``.rrd`` files of a workspace: metadata, names, and the trash.

Metadata is stored beside each file in ``.about/NAME.json``, and is valid as long as the size and time of the file are
unchanged. Files without valid metadata are read one by one in the background.
"""

import os
import shutil
import stat
import threading
import unicodedata
import uuid
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, NoReturn

from pydantic import AliasChoices, Field

from beliefscope.app.protocol.errors import NameTaken, NotFound
from beliefscope.app.workspace.json_files import RecordCache, read_record
from beliefscope.app.workspace.trash import Trash
from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.probe import RecordingInfo, RecordingProbe

ENDING = ".rrd"
MAX_STEM_BYTES = 200  # of a name without its ending; partial files have longer names
MAX_NAME_BYTES = 255  # of the file system


@dataclass(frozen=True)
class Record:
    """Stored metadata of a file, with the size and time (ns) of the file that it belongs to."""

    bytes: int
    modified: int
    info: Annotated[RecordingInfo | None, Field(validation_alias=AliasChoices("info", "about"))] = None


@dataclass(frozen=True)
class Recording:
    """A file in its current state.

    bytes, modified: size and time (s since 1970) of the file. info: None while the file is being read.
    """

    name: str
    bytes: int
    modified: float
    info: RecordingInfo | None


class RecordingFolder:
    """The recordings of one folder. Methods may be called from any thread, and may block.

    writer: writes recordings and figures in one thread, as matplotlib keeps fonts open per thread and has one style for
        all threads.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.trash = Trash(folder)
        self._lock = threading.RLock()
        self._records = RecordCache(partial(read_record, Record))
        self._probe = RecordingProbe()
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="reading recordings")
        self.writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="writing recordings")
        self._queued: set[tuple[str, int, int]] = set()  # name, size and time of the files that wait to be read

    def list_recordings(self) -> list[Recording]:
        """All recordings, most recent first. Files without valid metadata are read in the background."""
        recordings = []
        with self._lock:
            for path in self.folder.glob(f"*{ENDING}"):
                with suppress(NotFound):  # not a regular file, or deleted meanwhile
                    recordings.append(self.get(path.name))
        return sorted(recordings, key=lambda recording: (-recording.modified, recording.name))

    def get(self, name: str) -> Recording:
        """The recording; a file without valid metadata is read in the background. Raises NotFound."""
        path = self.path(name)
        with self._lock, suppress(FileNotFoundError):
            status = path.lstat()
            stamp = _stamp(status)
            record = self._records.get(self._record_path(path.name))
            info = None if record is None or (record.bytes, record.modified) != stamp else record.info
            if info is None and (path.name, *stamp) not in self._queued:
                self._queued.add((path.name, *stamp))
                self._reader.submit(self._read_metadata, path, stamp)
            return Recording(path.name, status.st_size, status.st_mtime, info)
        return _not_found(name)

    def path(self, name: str) -> Path:
        """Path of an existing regular file; links are not followed. Raises NotFound."""
        path = self.folder / (name.removesuffix(ENDING) + ENDING)
        with suppress(FileNotFoundError, NotADirectoryError):
            if "/" not in name and _is_listed(path.name) and stat.S_ISREG(path.lstat().st_mode):
                return path
        return _not_found(name)

    def path_for_new(self, name: str) -> Path:
        """Path for a new file. Raises BadInput for an invalid name, NameTaken for an existing one."""
        path = self.folder / (checked(name.removesuffix(ENDING)) + ENDING)
        if os.path.lexists(path):
            raise NameTaken(f"A recording {path.name!r} already exists. Choose another name.")
        return path

    @contextmanager
    def partial_file(self) -> Iterator[Path]:
        """Yields the path for a partial file, which is deleted at the end of the block unless it was moved."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f".{uuid.uuid4().hex}.part"
        try:
            yield path
        finally:
            path.unlink(missing_ok=True)

    def examine(self, path: Path) -> Future[RecordingInfo]:
        """Read a file in a subprocess, one at a time. The future raises BadInput if Rerun cannot read the file."""

        def read() -> RecordingInfo:
            info = self._probe(path)
            if not info.application:
                raise BadInput(info.problem)
            return info

        return self._reader.submit(read)

    def publish(self, part: Path, path: Path, info: RecordingInfo) -> None:
        """Move a complete file to its path. Its metadata is written first, so that no process reads the file for it."""
        with self._lock:
            self._store(path.name, _stamp(part.lstat()), info)
            os.rename(part, path)

    def add(self, part: Path, name: str, info: RecordingInfo) -> Recording:
        """Move an examined file to its name. Raises as ``path_for_new``."""
        with self._lock:
            path = self.path_for_new(name)
            self.publish(part, path, info)
            return self.get(path.name)

    def rename(self, name: str, new: str) -> Recording:
        """Raises NotFound, NameTaken, or BadInput for an invalid name."""
        with self._lock:
            path = self.path(name)
            if path.name == new.removesuffix(ENDING) + ENDING:
                return self.get(name)
            target = self.path_for_new(new)
            recording = self.get(name)
            try:
                if recording.info is None:
                    os.rename(path, target)
                else:
                    self.publish(path, target, recording.info)
            except FileNotFoundError:
                _not_found(name)
            self._record_path(path.name).unlink(missing_ok=True)
            return self.get(target.name)

    def delete(self, name: str) -> str:
        """Move a file into the trash; return its id there. Raises NotFound."""
        return self.trash.put(self.path(name))  # keeps the metadata for ``restore``

    def restore(self, id: str) -> Recording:
        """Restore a file from the trash. Raises NotFound or NameTaken."""
        return self.get(self.trash.restore(id).name)

    def close(self) -> None:
        """Stop reading and writing files."""
        self._probe.close()
        for executor in (self._reader, self.writer):
            executor.shutdown(wait=True, cancel_futures=True)

    def _record_path(self, name: str) -> Path:
        return self.folder / ".about" / f"{name}.json"

    def _store(self, name: str, stamp: tuple[int, int], info: RecordingInfo) -> None:
        self._records.put(self._record_path(name), Record(*stamp, info))

    def _read_metadata(self, path: Path, stamp: tuple[int, int]) -> None:
        try:
            with suppress(OSError, CancelledError):
                info = self._probe(path)
                with self._lock:
                    if _stamp(path.lstat()) == stamp:
                        self._store(path.name, stamp, info)
        finally:
            with self._lock:
                self._queued.remove((path.name, *stamp))


def checked(name: str) -> str:
    """The name in normal form C. Raises BadInput for a name, without its ending, that is not allowed."""
    name = unicodedata.normalize("NFC", name)
    invalid = next((sign for sign in name if sign in '/\\<>:"|?*' or not sign.isprintable()), None)
    if not name:
        problem = "is empty"
    elif invalid is not None:
        problem = f"contains {invalid!r}"
    elif name[0] in ". " or name[-1] in ". ":
        problem = "begins or ends with a dot or a space"
    elif len(name.encode(errors="replace")) > MAX_STEM_BYTES:
        problem = f"is longer than {MAX_STEM_BYTES} bytes"
    else:
        return name
    raise BadInput(f"Name {name[:MAX_STEM_BYTES]!r} {problem}. Use letters, digits, spaces and -_+.,()=.")


def free_space(folder: Path) -> int:
    """Free bytes on the disk of a folder, which need not exist."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(existing).free


def _is_listed(name: str) -> bool:
    """Whether a file with this name is listed: its name is printable, and its record's name is not too long."""
    valid = name[0] != "." and name.isprintable() and len(name.encode()) + len(".json") <= MAX_NAME_BYTES
    return name.endswith(ENDING) and valid


def _stamp(status: os.stat_result) -> tuple[int, int]:
    return status.st_size, status.st_mtime_ns


def _not_found(name: str) -> NoReturn:
    raise NotFound(f"Recording {name.removesuffix(ENDING) + ENDING!r} does not exist.")

"""The ``.rrd`` files of a workspace: metadata, tags, names, and the trash.

Metadata is cached beside each file in ``.about/NAME.json``, and is valid as long as the size and time of the file are
unchanged. Files without valid metadata are read one by one in the background.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
import threading
import unicodedata
import uuid
from collections.abc import Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Annotated, NoReturn

from pydantic import AliasChoices, Field, TypeAdapter

from beliefscope.app.workspace.json_files import read_record
from beliefscope.app.workspace.recording_probe import RecordingInfo, RecordingProbe
from beliefscope.app.workspace.trash import DeletedFile, NameTaken, NotFound, Trash
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically

ENDING = ".rrd"
MAX_STEM_BYTES = 200  # of a name without its ending; partial files have longer names
MAX_NAME_BYTES = 255  # of the file system
MAX_TAGS, MAX_TAG_LENGTH = 20, 40
MAX_QUEUED = 64  # files to be read in the background
MAX_AUTOMATIC, MAX_AUTOMATIC_BYTES = 50, 10**9  # recordings written for the Rerun tab


@dataclass(frozen=True)
class Record:
    """Stored metadata of a file.

    Attributes:
        bytes, modified: size and time (ns) of the file that ``info`` belongs to.
        original_name: name under which the server wrote the file.
        automatic: whether it was written for the Rerun tab and has not been kept by the user.
        info: None if the file has not been read.
    """

    bytes: int
    modified: int
    original_name: Annotated[str, Field(validation_alias=AliasChoices("original_name", "made_as"))] = ""
    automatic: bool = False
    tags: tuple[str, ...] = ()
    info: Annotated[RecordingInfo | None, Field(validation_alias=AliasChoices("info", "about"))] = None

    def describes(self, status: os.stat_result) -> bool:
        """Whether the file is unchanged."""
        return (self.bytes, self.modified) == _stamp(status)


RECORD = TypeAdapter(Record)


@dataclass(frozen=True)
class Recording:
    """A file in its current state.

    Attributes:
        bytes, modified: size and time (s since 1970) of the file.
        automatic: whether it was written for the Rerun tab; the oldest of these are deleted when there are many.
        info: None while the file is being read.
    """

    name: str
    bytes: int
    modified: float
    automatic: bool
    tags: tuple[str, ...]
    info: RecordingInfo | None


class RecordingFolder:
    """The recordings of one folder. Methods may be called from any thread, and may block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._metadata = folder / ".about"
        self._trash = Trash(folder)
        self._lock = threading.RLock()
        self._records: dict[str, tuple[int, Record]] = {}  # name -> (time of the record's file in ns, record)
        self._probe = RecordingProbe()
        self._background = ThreadPoolExecutor(max_workers=1, thread_name_prefix="reading recordings")
        self._uploads = ThreadPoolExecutor(max_workers=1, thread_name_prefix="examining recordings")
        self._queued: dict[str, tuple[int, int]] = {}  # name -> (bytes, ns)
        self._closing = False

    def list_recordings(self) -> list[Recording]:
        """All recordings, most recent first. Files without valid metadata are read in the background."""
        with self._lock:
            recordings = []
            for name, status in self._files():
                record = self._record(name)
                tags = () if record is None else record.tags
                if record is not None and not record.describes(status):
                    record = None
                info = None if record is None else record.info
                if info is None:
                    self._enqueue(name, _stamp(status))
                automatic = record is not None and record.automatic
                recordings.append(Recording(name, status.st_size, status.st_mtime, automatic, tags, info))
            return sorted(recordings, key=lambda recording: (-recording.modified, recording.name))

    def get(self, name: str) -> Recording:
        """Raises NotFound."""
        path = self.path(name)
        recordings = (recording for recording in self.list_recordings() if recording.name == path.name)
        return next(recordings, None) or _not_found(name)

    def list_deleted(self) -> list[DeletedFile]:
        """Recordings in the trash, most recent first."""
        with self._lock:
            return self._trash.list_deleted()

    def path(self, name: str) -> Path:
        """Path of an existing regular file; links are not followed. Raises NotFound."""
        path = self.folder / (name.removesuffix(ENDING) + ENDING)
        if "/" in name or not _is_listed(path.name):
            _not_found(name)
        try:
            regular = stat.S_ISREG(path.lstat().st_mode)
        except OSError:
            regular = False
        return path if regular else _not_found(name)

    def path_for_new(self, name: str) -> Path:
        """Path for a new file. Raises BadInput for an invalid name, NameTaken for an existing one."""
        path = self.folder / (checked(name.removesuffix(ENDING)) + ENDING)
        if os.path.lexists(path):
            raise NameTaken(f"A recording {path.name!r} already exists. Choose another name.")
        return path

    def find_generated(self, name: str) -> Path | None:
        """The file that the server wrote under this name, even if it has been renamed since; None without one."""
        with self._lock:
            for file, status in self._files():
                record = self._record(file)
                if record is None and file == name:
                    return self.folder / file  # the server ended before it saved the metadata
                if record and record.original_name == name and record.describes(status):
                    return self.folder / file
        return None

    def unused_path(self, name: str) -> Path:
        """Path for a new file with this name, followed by a number if necessary."""
        stem = name.removesuffix(ENDING)
        path = self.folder / f"{stem}{ENDING}"
        number = 2
        while os.path.lexists(path):
            path = self.folder / f"{stem}-{number}{ENDING}"
            number += 1
        return path

    def publish(self, part: Path, info: RecordingInfo, name: str, automatic: bool) -> Path:
        """Move a complete file that the server wrote to its name, followed by a number if necessary.

        The metadata is written first, so that no process reads the file for it. An automatic recording may replace
        the oldest ones.
        """
        with self._lock:
            path = self.unused_path(name)
            self._write(path.name, Record(*_stamp(part.lstat()), name, automatic, info=info))
            os.rename(part, path)
            if automatic:
                self._limit_automatic()
            return path

    def keep(self, name: str) -> Recording:
        """Exclude an automatic recording from automatic deletion. Raises NotFound."""
        with self._lock:
            path = self.path(name)
            record = self._record(path.name)
            if record is not None and record.automatic:
                self._write(path.name, replace(record, automatic=False))
            return self.get(name)

    def partial_path(self) -> Path:
        """Path for a partial file. The caller deletes it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        return self.folder / f".{uuid.uuid4().hex}.part"

    def examine(self, path: Path) -> Future[RecordingInfo]:
        """Read a file in a subprocess, one at a time. The future raises BadInput if Rerun cannot read the file."""

        def read() -> RecordingInfo:
            info = self._probe(path)
            if not info.application:
                raise BadInput(info.problem)
            return info

        return self._uploads.submit(read)

    def add(self, part: Path, name: str, info: RecordingInfo) -> Recording:
        """Move an examined file to its name. Raises as ``path_for_new``."""
        with self._lock:
            path = self.path_for_new(name)
            os.rename(part, path)
            self._write(path.name, Record(*_stamp(path.lstat()), info=info))
            return self.get(path.name)

    def rename(self, name: str, new: str) -> Recording:
        """Raises NotFound, NameTaken, or BadInput for an invalid name."""
        with self._lock:
            path = self.path(name)
            if path.name == new.removesuffix(ENDING) + ENDING:
                return self.get(name)
            target = self.path_for_new(new)
            record = self._record(path.name)
            if record is not None:  # written first, so that the file always has its tags
                self._write(target.name, replace(record, automatic=False))
            try:
                os.rename(path, target)
            except FileNotFoundError:
                self._delete_record(target.name)
                _not_found(name)
            self._delete_record(path.name)
            return self.get(target.name)

    def tag(self, name: str, tags: Sequence[str]) -> Recording:
        """Replace the tags of a file. Raises NotFound, or BadInput for an invalid tag."""
        valid = checked_tags(tags)
        with self._lock:
            path = self.path(name)
            record = self._record(path.name) or Record(0, 0)
            self._write(path.name, replace(record, tags=valid, automatic=False))
            return self.get(name)

    def delete(self, name: str) -> str:
        """Move a file into the trash; return its id there. Raises NotFound."""
        with self._lock:
            path = self.path(name)
            id = self._trash.put(path, self._record_path(path.name))
            self._records.pop(path.name, None)
            return id

    def restore(self, id: str) -> Recording:
        """Restore a file and its tags from the trash. Raises NotFound or NameTaken."""
        with self._lock:
            self._metadata.mkdir(parents=True, exist_ok=True)
            path = self._trash.restore(id, self.folder, self._metadata)
            self._records.pop(path.name, None)
            return self.keep(path.name)

    def empty_trash(self) -> None:
        """Delete the files in the trash permanently."""
        with self._lock:
            self._trash.empty()

    def close(self) -> None:
        """Stop reading files."""
        self._closing = True
        self._probe.close()
        for executor in (self._background, self._uploads):
            executor.shutdown(wait=True, cancel_futures=True)

    def _files(self) -> list[tuple[str, os.stat_result]]:
        """Names and states of all regular files."""
        files = []
        with suppress(FileNotFoundError):
            for entry in os.scandir(self.folder):
                if _is_listed(entry.name):
                    with suppress(FileNotFoundError):  # deleted meanwhile
                        if entry.is_file(follow_symlinks=False):
                            files.append((entry.name, entry.stat(follow_symlinks=False)))
        return files

    def _limit_automatic(self) -> None:
        """Delete the oldest automatic recordings beyond the limits, but not the newest one."""
        files = self._files()
        automatic = [(status, name) for name, status in files if (record := self._record(name)) and record.automatic]
        automatic.sort(key=lambda file: -file[0].st_mtime_ns)
        sizes = accumulate(status.st_size for status, _ in automatic)
        for index, ((_, name), size) in enumerate(zip(automatic, sizes, strict=True)):
            if index and (index >= MAX_AUTOMATIC or size > MAX_AUTOMATIC_BYTES):
                (self.folder / name).unlink(missing_ok=True)
                self._delete_record(name)

    def _record_path(self, name: str) -> Path:
        return self._metadata / f"{name}.json"

    def _record(self, name: str) -> Record | None:
        """The stored metadata; None if it is missing or invalid. Read again if another process has changed it."""
        with suppress(OSError, ValueError):
            path = self._record_path(name)
            modified = path.stat().st_mtime_ns
            if name not in self._records or self._records[name][0] != modified:
                record = read_record(RECORD, path)
                self._records[name] = modified, replace(record, tags=checked_tags(record.tags))
            return self._records[name][1]
        return None

    def _write(self, name: str, record: Record) -> None:
        self._metadata.mkdir(parents=True, exist_ok=True)
        write_atomically(self._record_path(name), json.dumps(asdict(record)).encode())
        self._records.pop(name, None)

    def _delete_record(self, name: str) -> None:
        self._record_path(name).unlink(missing_ok=True)
        self._records.pop(name, None)

    def _enqueue(self, name: str, stamp: tuple[int, int]) -> None:
        if self._closing or self._queued.get(name) == stamp or len(self._queued) >= MAX_QUEUED:
            return
        self._queued[name] = stamp
        self._background.submit(self._read_metadata, name, stamp)

    def _read_metadata(self, name: str, stamp: tuple[int, int]) -> None:
        try:
            with suppress(OSError, CancelledError):
                info = self._probe(self.folder / name)
                with self._lock:
                    if _stamp((self.folder / name).lstat()) == stamp:
                        record = self._record(name) or Record(*stamp)
                        self._write(name, Record(*stamp, tags=record.tags, info=info))
        finally:
            with self._lock:
                self._queued.pop(name, None)


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


def checked_tags(tags: Sequence[str]) -> tuple[str, ...]:
    """The tags without duplicates. Raises BadInput for a tag that is not allowed, or too many."""
    unique: dict[str, str] = {}
    for tag in (" ".join(tag.split()) for tag in tags):
        if not tag or len(tag) > MAX_TAG_LENGTH or "," in tag or not tag.isprintable():
            raise BadInput(f"Tag {tag[:MAX_TAG_LENGTH]!r} is not 1 to {MAX_TAG_LENGTH} characters without a comma.")
        unique.setdefault(tag.casefold(), tag)
    if len(unique) > MAX_TAGS:
        raise BadInput(f"{len(unique)} tags are too many: at most {MAX_TAGS} are allowed.")
    return tuple(unique.values())


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

"""The reports of a workspace: one folder each, with a manifest."""

from __future__ import annotations

import re
import threading
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, TypeAdapter

from beliefscope.app.workspace.json_files import read_record
from beliefscope.app.workspace.paths import file_within
from beliefscope.app.workspace.trash import DeletedFile, NotFound, Trash, disk_usage
from beliefscope.datasets.faults.injection import Faults

NAME = re.compile(r"[\w.+-]+-episode\d+-[0-9a-f]{8}")


class ManifestRun(BaseModel):
    """The run of a report."""

    episode: int
    faults: Any


class Manifest(BaseModel):
    """Fields of a report's manifest (``recordings.report``). made: ISO 8601. files: SHA-256 by name."""

    title: str
    made: str
    task: str
    filter: str
    traces: Annotated[list[ManifestRun], Field(min_length=1, max_length=1)]
    files: dict[str, str]


MANIFEST = TypeAdapter(Manifest)


class ReportFolder:
    """The reports of a workspace. Thread-safe; methods block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._trash = Trash(folder)
        self._lock = threading.Lock()
        self._entries: dict[str, tuple[int, dict[str, Any]]] = {}  # name -> (mtime of the manifest in ns, entry)

    def list_reports(self) -> list[dict[str, Any]]:
        """All reports, newest first."""
        with self._lock:
            manifests = [path for path in self.folder.glob("*/manifest.json") if NAME.fullmatch(path.parent.name)]
            entries = [self._entry(path) for path in manifests]
        return sorted((entry for entry in entries if entry), key=lambda entry: entry["created"], reverse=True)

    def page(self, name: str, file: str = "report.html") -> Path:
        """Path of a file of a report. Raises NotFound."""
        path = self.folder / name / file
        if not NAME.fullmatch(name) or path.parent.is_symlink() or not file_within(self.folder, f"{name}/{file}"):
            raise NotFound(f"Report {name!r} does not exist.")
        return path

    def delete(self, name: str) -> str:
        """Move a report to the trash; the id that restores it. Raises NotFound."""
        with self._lock:
            return self._trash.put(self.page(name).parent)

    def restore(self, id: str) -> str:
        """Restore a deleted report; its name. Raises NotFound, and NameTaken if it has been created again."""
        with self._lock:
            return self._trash.restore(id, self.folder).name

    def list_deleted(self) -> list[DeletedFile]:
        """Deleted reports, most recently deleted first."""
        with self._lock:
            return self._trash.list_deleted()

    def empty_trash(self) -> None:
        """Delete all deleted reports permanently."""
        with self._lock:
            self._trash.empty()

    def _entry(self, path: Path) -> dict[str, Any] | None:
        """A report from its manifest (cached); None if that cannot be read."""
        name = path.parent.name
        with suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
            modified = path.stat().st_mtime_ns
            if name not in self._entries or self._entries[name][0] != modified:
                manifest = read_record(MANIFEST, path)
                run = manifest.traces[0]
                self._entries[name] = (
                    modified,
                    {
                        **manifest.model_dump(include={"title", "task", "filter"}),
                        "created": manifest.made,
                        "episode": run.episode,
                        "faults": str(Faults.from_json(run.faults)),
                        "name": name,
                        "url": f"/api/reports/{name}.html",
                        "bytes": disk_usage(path.parent),
                        "pdf": f"/api/reports/{name}.pdf" if "report.pdf" in manifest.files else None,
                    },
                )
            return self._entries[name][1]
        return None

"""The reports of a workspace: one folder each, with a manifest."""

import re
import threading
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter

from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.workspace.json_files import RecordCache, content
from beliefscope.app.workspace.paths import file_within
from beliefscope.app.workspace.trash import Trash, disk_usage
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.io.strict_json import read_json

NAME = re.compile(r"[\w.+-]+-episode\d+-[0-9a-f]{8}")


@dataclass(frozen=True)
class ReportEntry:
    """A report. filter: its own name. created: ISO 8601. pdf: address of its PDF, or None.

    data_hash: of the episode; empty if it is unknown. data: the data set of this server with it, or None.
    """

    name: str
    url: str
    title: str
    created: str
    task: str
    filter: str
    checkpoint_hash: str
    episode: int
    data_hash: str
    faults: str
    bytes: int
    pdf: str | None
    data: str | None = None


ENTRY = TypeAdapter(ReportEntry)


class ReportFolder:
    """The reports of a workspace. Thread-safe; methods block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.trash = Trash(folder)
        self._lock = threading.Lock()
        self._entries = RecordCache(_read_entry)

    def list_reports(self) -> list[ReportEntry]:
        """All reports, newest first. Skips folders whose manifest cannot be read."""
        paths = [path for path in self.folder.glob("*/manifest.json") if NAME.fullmatch(path.parent.name)]
        with self._lock:
            entries = [self._entries.get(path) for path in paths]
        return sorted((entry for entry in entries if entry), key=lambda entry: entry.created, reverse=True)

    def page(self, name: str, file: str = "report.html") -> Path:
        """Path of a file of a report. Raises NotFound."""
        path = self.folder / name / file
        if not NAME.fullmatch(name) or path.parent.is_symlink() or not file_within(self.folder, f"{name}/{file}"):
            raise NotFound(f"Report {name!r} does not exist.")
        return path


def _read_entry(path: Path) -> ReportEntry:
    """A report from its manifest (``recordings.report``). Raises OSError or ValueError."""
    manifest, name = read_json(content(path)), path.parent.name
    try:
        (run,) = manifest["traces"]
        entry = {
            "name": name,
            "url": f"/api/reports/{name}.html",
            **{key: manifest[key] for key in ("title", "task", "filter")},
            "checkpoint_hash": manifest.get("checkpoint_hash", ""),
            "created": manifest["made"],
            "episode": run["episode"],
            "data_hash": run.get("data_hash", ""),
            "faults": str(Faults.from_json(run["faults"])),
            "bytes": disk_usage(path.parent),
            "pdf": f"/api/reports/{name}.pdf" if "report.pdf" in manifest["files"] else None,
        }
    except (LookupError, TypeError) as error:
        raise ValueError(f"invalid manifest: {error}") from None
    return ENTRY.validate_python(entry)

"""Models of JSON responses: recordings and reports."""

from dataclasses import dataclass

from pydantic import ConfigDict, with_config

from beliefscope.app.api.models.catalog import Reply
from beliefscope.app.workspace.reports import ReportEntry
from beliefscope.app.workspace.trash import DeletedFile
from beliefscope.recordings.probe import RecordingInfo


class DeletedId(Reply):
    """Id that restores a deleted file."""

    deleted: str


class Freed(Reply):
    """Size of permanently deleted files."""

    freed: int


class RunNames(Reply):
    """Names of a filter and a data set in the catalog."""

    filter: str
    data: str


@with_config(ConfigDict(json_schema_serialization_defaults_required=True))
@dataclass(frozen=True, kw_only=True)
class RecordingEntry(RecordingInfo):
    """A recording, with its metadata once they have been read.

    modified: ISO 8601. reading: whether its metadata are being read. run: the same run in the catalog, or None;
    ``why_not`` explains why.
    """

    name: str
    url: str
    bytes: int
    modified: str
    reading: bool
    run: RunNames | None
    why_not: str


class RecordingList(Reply):
    """Recordings, newest first, and deleted ones. bytes, free, largest: used, free, and allowed for an upload."""

    recordings: list[RecordingEntry]
    deleted: list[DeletedFile]
    bytes: int
    free: int
    largest: int


class WrittenRecording(Reply):
    """A recording of a run. seconds: that writing took; None if it existed."""

    name: str
    url: str
    bytes: int
    seconds: float | None


class ReportList(Reply):
    """Reports, newest first, and deleted ones."""

    reports: list[ReportEntry]
    deleted: list[DeletedFile]


class Name(Reply):
    """Name of a restored report."""

    name: str

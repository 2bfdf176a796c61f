"""Models of JSON responses: recordings and reports."""

from __future__ import annotations

from beliefscope.app.api.models.catalog import Reply
from beliefscope.app.workspace.trash import DeletedFile


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


class RecordingEntry(Reply):
    """A recording.

    Attributes:
        automatic: written for display only. reading: whether its metadata are being read.
        task ... data_hash: of its run; None or empty for recordings of other applications.
        problem: why no run can be read from it, or empty.
        run: the same run in the catalog, or None; ``why_not`` explains why.
    """

    name: str
    url: str
    bytes: int
    modified: str
    automatic: bool
    tags: list[str]
    reading: bool
    application: str
    title: str
    entities: int
    rows: int
    problem: str
    task: str | None
    filter: str | None
    episode: int | None
    steps: int | None
    seed: int | None
    faults: str
    particles: int | None
    edited: bool
    checkpoint_hash: str
    data_hash: str
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


class ReportEntry(Reply):
    """A report. created: ISO 8601. pdf: address of its PDF, or None."""

    name: str
    url: str
    title: str
    created: str
    task: str
    filter: str
    episode: int
    faults: str
    bytes: int
    pdf: str | None


class ReportList(Reply):
    """Reports, newest first, and deleted ones."""

    reports: list[ReportEntry]
    deleted: list[DeletedFile]


class Name(Reply):
    """Name of a restored report."""

    name: str

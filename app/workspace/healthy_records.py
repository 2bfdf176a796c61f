"""Healthy records that jobs measured, for filters that have none of their own, such as external ones."""

import copy
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from beliefscope.app.workspace.json_files import RecordCache, read_record
from beliefscope.filters.checkpoint import Checkpoint

_RECORD = TypeAdapter(dict[str, Any])


class HealthyRecords:
    """The records of one folder, by the hash of the filter. Not thread-safe."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._records = RecordCache(lambda path: read_record(_RECORD, path))

    def get(self, checkpoint_hash: str) -> dict[str, Any] | None:
        """JSON of ``beliefscope.inspect.diagnostics.healthy_profile``; None if none was measured."""
        return self._records.get(self._path(checkpoint_hash))

    def version(self, checkpoint_hash: str) -> int | None:
        """Differs between measurements of a record; None if none was measured."""
        return self._records.modified(self._path(checkpoint_hash))

    def put(self, checkpoint_hash: str, record: dict[str, Any]) -> None:
        """Write a record; replaces an earlier one."""
        self._records.put(self._path(checkpoint_hash), record)

    def complete(self, checkpoint: Checkpoint) -> Checkpoint:
        """The filter with its measured record, if there is one."""
        record = self.get(checkpoint.hash)
        if record is None:
            return checkpoint
        completed = copy.copy(checkpoint)
        object.__setattr__(completed, "healthy_profile", record)  # a checkpoint is frozen
        return completed

    def _path(self, checkpoint_hash: str) -> Path:
        return self._folder / f"{checkpoint_hash}.json"

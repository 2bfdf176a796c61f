"""Healthy records that were measured for filters, in the folder ``healthy`` of a workspace."""

import copy
import hashlib
from pathlib import Path
from typing import Any

from beliefscope.app.workspace.json_files import read_record
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.unavailable import UnavailableFilter


def record_path(workspace: Path, checkpoint: Checkpoint) -> Path:
    """File of the healthy record of a filter: by its hash, of one known by recorded runs also by task and name."""
    name = checkpoint.hash
    if isinstance(checkpoint, UnavailableFilter):  # logs may have no hash
        parts = (checkpoint.task.name, checkpoint.name, checkpoint.hash)
        name = hashlib.sha256(repr(parts).encode()).hexdigest()
    return workspace / "healthy" / f"{name}.json"


def with_record(checkpoint: Checkpoint, record: dict[str, Any]) -> Checkpoint:
    """A copy of the filter with another healthy record."""
    checkpoint = copy.copy(checkpoint)
    object.__setattr__(checkpoint, "healthy_profile", record)  # a checkpoint is frozen
    return checkpoint


def with_kept_record(checkpoint: Checkpoint, workspace: Path) -> Checkpoint:
    """The filter with its healthy record in the workspace, if there is one. Raises BadInput for an invalid file."""
    path = record_path(workspace, checkpoint)
    if not path.is_file():
        return checkpoint
    try:
        return with_record(checkpoint, read_record(dict[str, Any], path))
    except (OSError, ValueError) as error:
        raise BadInput(f"{path} is not a healthy record: {error}; measure it again with --profile-from") from None

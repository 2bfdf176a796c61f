"""Healthy records that were measured for filters, in the folder ``healthy`` of a workspace."""

import hashlib
from pathlib import Path

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.unavailable import UnavailableFilter


def record_path(workspace: Path, checkpoint: Checkpoint) -> Path:
    """File of the healthy record of a filter: by its hash, of one known by recorded runs also by task and name."""
    name = checkpoint.hash
    if isinstance(checkpoint, UnavailableFilter):  # logs may have no hash
        parts = (checkpoint.task.name, checkpoint.name, checkpoint.hash)
        name = hashlib.sha256(repr(parts).encode()).hexdigest()
    return workspace / "healthy" / f"{name}.json"

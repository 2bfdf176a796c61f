"""Partial files of interrupted writes: hidden files that end in ``.part``."""

import time
from contextlib import suppress
from pathlib import Path

FOLDERS = ("cache", "finetune", "jobs", "live", "recordings", "reports", "traces")
"""Folders of a workspace that belong to Beliefscope. The workspace may contain other files."""

MAX_AGE = 3600.0  # s since the last write


def delete_abandoned_parts(workspace: Path) -> None:
    """Delete partial files that are not being written any more. Ignores links and files that cannot be deleted."""
    for paths in (workspace.glob(".*.part"), *((workspace / name).rglob(".*.part") for name in FOLDERS)):
        for path in paths:
            with suppress(OSError):
                if path.lstat().st_mtime < time.time() - MAX_AGE:
                    path.unlink()

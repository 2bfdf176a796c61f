"""What a kill leaves in a workspace of a file that was being written: a hidden file that ends in ``.part``."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

FOLDERS = ("cache", "finetune", "jobs", "live", "recordings", "reports", "traces")
"""Of a workspace, that are ours with all that is in them. Beside them there may be anything."""

ABANDONED = 3600.0
"""s without a byte, after which nobody is writing any more."""


def sweep(workspace: Path) -> None:
    """Deletes them. Links are not followed, and what cannot be deleted stays."""
    for found in (workspace.glob(".*.part"), *((workspace / name).rglob(".*.part") for name in FOLDERS)):
        for path in found:
            with suppress(OSError):
                if path.lstat().st_mtime < time.time() - ABANDONED:
                    path.unlink()

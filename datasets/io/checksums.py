"""Hashes of the pretrained filters and the sample data, in the format of sha256sum."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

SUMS = "SHA256SUMS"


def read_sums(folder: Path) -> dict[str, str]:
    """File name -> SHA-256 in the folder's list."""
    lines = (folder / SUMS).read_text(encoding="utf-8").splitlines()
    return {name: digest for digest, name in (line.split(maxsplit=1) for line in lines)}


def changed_files(folder: Path) -> list[str]:
    """Names of the listed files that are missing or whose hash differs."""

    def digest(name: str) -> str:
        with suppress(OSError):
            return hashlib.sha256((folder / name).read_bytes()).hexdigest()
        return ""

    return [name for name, expected in read_sums(folder).items() if digest(name) != expected]

"""A file reader under test, and helpers to corrupt files and check results."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

Write = Callable[[Path], None]
Corrupt = Callable[[Path, Random], None]
Read = Callable[[Path], None]


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        write: writes a valid file. corrupt: modifies it in place. read: reads it as the program does.
    """

    write: Write
    corrupt: Corrupt
    read: Read
    suffix: str = ""


def corrupt_with(change: Callable[[bytes, Random], bytes]) -> Corrupt:
    """Corrupt a file by changing its bytes."""

    def corrupt(path: Path, rng: Random) -> None:
        path.write_bytes(change(path.read_bytes(), rng))

    return corrupt


def check_serializable(value: Any) -> None:
    """Serialize as the server does: without NaN and lone surrogates."""
    json.dumps(value, allow_nan=False, ensure_ascii=False).encode()

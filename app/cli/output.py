"""What the command line says: results to standard output, everything else to standard error."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn


def fail(message: str, code: int) -> NoReturn:
    """Ends the process with one line on standard error."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(code)


def written() -> None:
    """Has standard output written now, while what goes wrong with it can be told. Raises OSError."""
    try:
        sys.stdout.flush()
    except OSError:
        # What is left is dropped: as Python ends it would try again, and fail in its own words.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise


def say(line: str) -> None:
    """One line beside the result, on standard error."""
    print(line, file=sys.stderr)


def result(document: Mapping[str, Any], text: str, destination: str | None) -> None:
    """A command's result: as text, or as one JSON document where ``destination`` is ``-``; to standard output.

    JSON knows no infinity and no NaN: a number that is not finite is null.
    """
    print(text if destination is None else json.dumps(_finite(document), indent=2, allow_nan=False))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(rows: Mapping[str, str]) -> str:
    """Two columns, the second aligned to the right."""
    left, right = max(map(len, rows)), max(map(len, rows.values()))
    return "\n".join(f"{name:<{left}}  {value:>{right}}" for name, value in rows.items())


def grid(title: str, columns: Sequence[str], rows: Sequence[Sequence[str | int | float | None]]) -> str:
    """A table under its title; numbers to the right with three digits, unknown ones as ``-``."""

    def shown(value: str | int | float | None) -> str:
        return "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)

    cells = [list(columns), *([shown(value) for value in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    numeric = [bool(rows) and not any(isinstance(row[i], str) for row in rows) for i in range(len(columns))]
    lines = [
        "  ".join(
            f"{cell:{'>' if right else '<'}{width}}" for cell, width, right in zip(row, widths, numeric, strict=True)
        )
        for row in cells
    ]
    return "\n".join([title, *(f"  {line.rstrip()}" for line in lines)])


@contextmanager
def progress(label: str) -> Iterator[Callable[[float], None]]:
    """One bar on standard error, moved by what is yielded: called with the share done, 0..1."""
    with bars() as move:
        yield lambda share: move(label, share, "")


@contextmanager
def bars() -> Iterator[Callable[[str, float, str], None]]:
    """Bars on standard error, each there from its first move on; yields (label, share done, note) -> None."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    view = Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True))
    known: dict[str, TaskID] = {}

    def move(label: str, share: float, note: str) -> None:
        if label not in known:
            known[label] = view.add_task(label, total=1.0, note=note)
            view.start()
        view.update(known[label], completed=share, note=note)

    try:
        yield move
    finally:
        # A view that was never started would still end with an empty line.
        if known:
            view.stop()

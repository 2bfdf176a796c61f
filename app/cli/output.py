"""Output of the command line: results on standard output, everything else on standard error."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from rich.console import RenderableType

    from beliefscope.inspect.diagnostics.views import Table


def fail(message: str, code: int) -> NoReturn:
    """Exit with one line on standard error."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(code)


def flush() -> None:
    """Flush standard output while errors can still be reported. Raises OSError."""
    try:
        sys.stdout.flush()
    except OSError:
        # Discard the rest: otherwise the interpreter retries on exit and prints its own error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise


def note(line: str) -> None:
    """Print one line to standard error."""
    print(line, file=sys.stderr)


def result(document: Mapping[str, Any], text: str, destination: str | None) -> None:
    """Print the result of a command: the text, or the JSON document if ``destination`` is ``-``."""
    print(text if destination is None else json.dumps(_finite(document), indent=2, allow_nan=False))


def _finite(value: Any) -> Any:
    """Replace infinite and NaN values by None, because JSON has neither."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def grid(title: str, columns: Sequence[str], rows: Sequence[Sequence[str | int | float | None]]) -> str:
    """Format a table with a title; numbers are right-aligned with three digits, None is ``-``."""

    def text(value: str | int | float | None) -> str:
        return "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)

    cells = [list(columns), *([text(value) for value in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    alignments = [
        ">" if rows and not any(isinstance(row[i], str) for row in rows) else "<" for i in range(len(columns))
    ]
    lines = [
        "  ".join(f"{cell:{align}{width}}" for cell, width, align in zip(row, widths, alignments, strict=True))
        for row in cells
    ]
    return "\n".join([title, *(f"  {line.rstrip()}" for line in lines)])


def grids(tables: Iterable[Table]) -> list[str]:
    """Format several tables."""
    return [grid(table.title, table.columns, table.rows) for table in tables]


def render(*items: RenderableType) -> str:
    """Render rich tables or trees as plain text without a width limit."""
    from rich.console import Console

    console = Console(width=1000, color_system=None)
    with console.capture() as capture:
        console.print(*items, sep="\n")
    return "\n".join(line.rstrip() for line in capture.get().splitlines()).strip("\n")


@contextmanager
def progress(label: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar on standard error; yields a function that sets the completed fraction."""
    with bars() as update:
        yield lambda fraction: update(label, fraction, "")


@contextmanager
def bars() -> Iterator[Callable[[str, float, str], None]]:
    """Show progress bars on standard error; yields (label, completed fraction, note) -> None.

    A bar appears with its first update.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    view = Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True))
    tasks: dict[str, TaskID] = {}

    def update(label: str, fraction: float, note: str) -> None:
        if label not in tasks:
            tasks[label] = view.add_task(label, total=1.0, note=note)
            view.start()
        view.update(tasks[label], completed=fraction, note=note)

    try:
        yield update
    finally:
        # Stopping a view that was never started prints an empty line.
        if tasks:
            view.stop()

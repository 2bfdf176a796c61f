"""Output of the command line: results on standard output, everything else on standard error."""

from __future__ import annotations

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from beliefscope.app.jobs.remaining_time import RemainingTime
from beliefscope.datasets.text import plural


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


@dataclass(frozen=True)
class Result:
    """What a command returns: it is printed as text, or as one JSON document with ``--json -``.

    path: the written file; named before the text, and in the document with its size. code: exit code.
    """

    document: Mapping[str, Any]
    text: str
    path: Path | None = None
    code: int = 0

    def print(self, json_destination: str | None) -> None:
        """Print the text, or the JSON document to the destination ``-``."""
        from beliefscope.inspect.diagnostics.views import as_json

        document, text = self.described()
        print(text if json_destination is None else json.dumps(as_json(document), indent=2, allow_nan=False))

    def described(self) -> tuple[dict[str, Any], str]:
        """Document and text with the path and size of the written file, if there is one."""
        if self.path is None:
            return dict(self.document), self.text
        size = self.path.stat().st_size
        amount = f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"
        return {**self.document, "path": str(self.path), "bytes": size}, f"{self.path} ({amount}): {self.text}"


def arrow(title: str, rows: Any, top: int, command: str = "") -> str:
    """Format the first rows of an Arrow table, with the ``--top`` of ``command`` for all; hashes are shortened."""
    from beliefscope.inspect.diagnostics.views import format_table

    def short(value: Any) -> Any:
        return value[:12] if isinstance(value, str) and len(value) == 64 else value

    first = [list(map(short, row.values())) for row in rows.slice(0, top).to_pylist()]
    more = f"\n{plural(len(rows) - top, 'more row')}: {command}--top {len(rows)}" if len(rows) > top else ""
    return format_table(title, rows.column_names, first) + more


@contextmanager
def progress(label: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar on standard error; yields a function that sets the completed fraction."""
    with bars() as update:
        yield lambda fraction: update(label, fraction, "")


@contextmanager
def bars() -> Iterator[Callable[[str, float, str], None]]:
    """Show progress bars on standard error; yields (label, completed fraction, note) -> None.

    A bar appears with its first update. If standard error is not a terminal, lines are printed instead.
    """
    if not sys.stderr.isatty():
        yield _progress_lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
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


def _progress_lines() -> Callable[[str, float, str], None]:
    """(label, completed fraction, note) -> None; prints a line at every tenth, at most one per second, and at 1."""
    began = last = time.monotonic()
    tenths: dict[str, int] = {}
    times_left: defaultdict[str, RemainingTime] = defaultdict(RemainingTime)

    def update(label: str, fraction: float, text: str) -> None:
        nonlocal last
        tenth, now = int(10 * fraction + 1e-9), time.monotonic()
        remaining = times_left[label].update(fraction, now)
        if tenth <= tenths.get(label, 0) or (tenth < 10 and now - last < 1):
            return
        tenths[label], last = tenth, now
        left = f", {remaining:.0f} s left" if remaining is not None and tenth < 10 else ""
        note(f"{label}: {10 * tenth} %, {now - began:.0f} s{left}" + (f", {text}" if text else ""))

    return update

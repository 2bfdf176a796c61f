"""Views of a result: tables, curves, plots and image panels, shared by page, recordings, figures and reports.

Values are in display units: cm and degrees.
"""

from __future__ import annotations

import dataclasses
import math
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, time, timedelta
from decimal import Decimal
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.notebook_html import html_paragraph, html_table
from beliefscope.datasets.task import Task

Array = NDArray[np.float64]
Value = str | int | float | None
NOTE_WIDTH = 110  # characters
TABLE_WIDTH = 240  # characters: of a table without continuation
VIEWS = ("tables", "curves", "bands", "plots", "images")


@dataclass(frozen=True)
class Table:
    """Rows of values, None where a value is not available, such as NaN. Column names include the unit.

    note: explains columns, below the table.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Value]]
    note: str = ""

    def __post_init__(self) -> None:
        """Tuples of Python's values."""
        object.__setattr__(self, "columns", tuple(self.columns))
        object.__setattr__(self, "rows", tuple(tuple(map(_plain, row)) for row in self.rows))

    @classmethod
    def from_rows(cls, title: str, rows: Sequence[Mapping[str, Any]], note: str = "") -> Table:
        """Rows of column -> value; the columns are those of the first one."""
        return cls(title, tuple(rows[0] if rows else ()), [tuple(row.values()) for row in rows], note)

    def __str__(self) -> str:
        """The table as text."""
        return format_table(self.title, self.columns, self.rows, self.note)


@dataclass(frozen=True)
class Curve:
    """A quantity over the steps of one trace.

    Attributes:
        name: legend text.
        values: (T,), NaN where undefined.
        chart: title of the chart; curves of one chart share its axes.
        unit: display unit.
        layer: modality, ``fused`` or ``truth``; determines the colour.
        bounds: expected range of the values, if any.
    """

    name: str
    values: Array
    chart: str
    unit: str = ""
    layer: str = ""
    bounds: tuple[float, float] | None = None


@dataclass(frozen=True)
class Line:
    """One series of a plot: x and y (S,), and the layer that determines its colour."""

    name: str
    x: Array
    y: Array
    layer: str = ""


@dataclass(frozen=True)
class Plot:
    """A plot whose x axis is not time.

    Attributes:
        diagonal: whether to draw the ideal y = x.
        names: category names of x = 0, 1, ...
    """

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    kind: Literal["line", "points", "bars"] = "line"
    diagonal: bool = False
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class ImagePanel:
    """A value per pixel (H, W), such as an attribution. ``signed``: use a colour map symmetric about zero."""

    title: str
    values: Array
    unit: str = ""
    signed: bool = True


class Views(ABC):
    """A result with a verdict and views; subclasses are frozen dataclasses whose fields are its numbers."""

    def __init_subclass__(cls) -> None:
        """Results print their verdict: ``dataclass`` keeps a method that the class has."""
        cls.__repr__ = Views._one_line  # type: ignore[assignment]

    def _one_line(self) -> str:
        return f"<{type(self).__name__}: {self.verdict}>"

    @property
    @abstractmethod
    def verdict(self) -> str:
        """Summary of the numbers in one or two sentences."""

    def tables(self) -> list[Table]:
        """The numbers as tables."""
        return []

    @property
    def text(self) -> str:
        """Verdict and tables."""
        return "\n\n".join([self.verdict, *map(str, self.tables())])

    def curves(self) -> list[Curve]:
        """Curves over the steps of one trace; empty for results over several traces."""
        return []

    def bands(self) -> dict[str, NDArray[np.bool_]]:
        """Phase (``contact``, ``blackout``) -> mask (T,), shaded behind the curves."""
        return {}

    def plots(self) -> list[Plot]:
        """Plots over other quantities than time."""
        return []

    def images(self) -> list[ImagePanel]:
        """Values per pixel."""
        return []

    def to_dict(self) -> dict[str, Any]:
        """Verdict and all fields as JSON values: arrays as lists, non-finite numbers as None."""
        values = {f.name: as_json(getattr(self, f.name)) for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        return {"verdict": self.verdict, **values}

    def _repr_html_(self) -> str:
        """Verdict and tables in a notebook."""
        return html_result(self.verdict, self.tables())

    def views(self) -> dict[str, Any]:
        """Verdict and all ``VIEWS`` as JSON values."""
        return {"verdict": self.verdict, **{name: as_json(getattr(self, name)()) for name in VIEWS}}


def known_number(value: float) -> float | None:
    """A number; None for one that is not finite."""
    return value if math.isfinite(value) else None


def _plain(value: Any) -> Value:
    plain: Value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and math.isnan(plain) else plain


def html_result(headline: str, tables: Sequence[Table]) -> str:
    """A sentence and tables as HTML for notebooks."""
    parts = [html_paragraph(headline, strong=True)]
    for table in tables:
        parts.append(html_table(table.title, table.columns, table.rows))
        parts += [html_paragraph(table.note)] if table.note else []
    return "".join(parts)


def format_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Value]], note: str = "") -> str:
    """A table with a title and a note as text; numbers are right-aligned with three digits, None and NaN are ``-``.

    A table that is wider than ``TABLE_WIDTH`` continues below, where each part repeats the columns that name the rows.
    """

    def text(value: Value) -> str:
        return "-" if value is None or value != value else f"{value:z.3g}" if isinstance(value, float) else str(value)

    cells = [list(columns), *([text(value) for value in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    alignments = [
        ">" if rows and not any(isinstance(row[i], str) for row in rows) else "<" for i in range(len(columns))
    ]
    names = next((i for i, align in enumerate(alignments) if align == ">"), len(columns)) or min(2, len(columns))
    parts = [list(range(names))]
    for i in range(names, len(columns)):
        if len(parts[-1]) > names and sum(widths[k] + 2 for k in (*parts[-1], i)) > TABLE_WIDTH:
            parts.append(list(range(names)))
        parts[-1].append(i)
    blocks = [["  ".join(f"{row[i]:{alignments[i]}{widths[i]}}" for i in part) for row in cells] for part in parts]
    lines = [line for block in blocks for line in ("", *block)][1:]
    return "\n".join([title, *(f"  {line}".rstrip() for line in (*lines, *textwrap.wrap(note, NOTE_WIDTH)))])


def as_json(value: Any) -> Any:
    """Dataclasses, arrays, mappings and values of a database as JSON values.

    Tasks are their names, non-finite numbers None, dates and times text.
    """
    if isinstance(value, Task):
        return value.name
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: as_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return as_json(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [as_json(item) for item in value]
    if isinstance(value, Decimal):
        return as_json(float(value))
    if isinstance(value, date | time | timedelta | bytes):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value

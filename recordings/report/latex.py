"""Tables of a report for LaTeX, with the rules of the package booktabs."""

from __future__ import annotations

import math
import re

from beliefscope.inspect.diagnostics.views import Table, Value
from beliefscope.recordings.report.sections import number_text, text_columns

SPECIAL = {
    "\\": r"\textbackslash{}",
    **{character: f"\\{character}" for character in "{}$&#%_"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "°": r"\textdegree{}",
    "±": r"\textpm{}",
    "·": r"\textperiodcentered{}",
    "\N{MINUS SIGN}": r"\textminus{}",
    "→": r"\textrightarrow{}",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "\N{GREEK SMALL LETTER SIGMA}": r"$\sigma$",
    "β": r"$\beta$",
    "χ": r"$\chi$",
    "²": r"\texttwosuperior{}",
    "`": "",
    "\n": " ",
}
"""Character -> LaTeX; backticks mark commands on the page."""

NUMBER = re.compile(r"-?[0-9.]+(e[-+][0-9]+)?")

_TRANSLATION = str.maketrans(SPECIAL)


def latex_table(table: Table) -> str:
    """The table as ``tabular``: numbers with three significant digits at the right, a dash for unknown values."""
    alignment = "".join("l" if is_text else "r" for is_text in text_columns(table))
    head, *lines = [f"{' & '.join(map(_cell, row))} \\\\" for row in (table.columns, *table.rows)]
    return "\n".join(
        [
            f"% {' '.join(table.title.split())}. Requires \\usepackage{{booktabs}}.",
            f"\\begin{{tabular}}{{{alignment}}}",
            "\\toprule",
            head,
            "\\midrule",
            *lines,
            "\\bottomrule",
            "\\end{tabular}",
            "",
        ]
    )


def _cell(value: Value) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "--"
    if isinstance(value, float) and math.isfinite(value):
        text = number_text(value)
        if not NUMBER.fullmatch(text):  # a probability that is displayed as words
            return _escaped(text)
        digits, _, exponent = text.partition("e")
        return f"${digits} \\cdot 10^{{{int(exponent)}}}$" if exponent else f"${digits}$"
    return f"${value}$" if type(value) is int else _escaped(str(value))


def _escaped(text: str) -> str:
    return text.replace("->", "→").translate(_TRANSLATION)

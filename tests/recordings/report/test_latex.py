"""Tables for LaTeX: valid syntax for any text, and the digits of the page."""

from __future__ import annotations

import re

import pytest

from beliefscope.inspect.diagnosis.cause import Probability
from beliefscope.inspect.diagnostics.views import Table
from beliefscope.recordings.report.latex import latex_table

TEXTS = ["plain", "hinge_x & 50 % {of} $5", r"C:\runs~1^2 # <a> | b", "a -> `b`\nc", "χ² ≤ 3, 2 °, β → ±", ""]


def check(text: str, columns: int, rows: int) -> list[list[str]]:
    """The cells of a table, head first; every brace and environment is closed, no special character is bare."""
    comment, body = text.split("\n", 1)
    assert comment.startswith("% ")
    bare = re.sub(r"\\[\\{}$&#%_]", "", body)
    depth = 0
    for character in bare:
        depth += {"{": 1, "}": -1}.get(character, 0)
        assert depth >= 0
    assert depth == 0
    assert bare.count("$") % 2 == 0
    assert not set(re.sub(r"\$.*?\$", "", bare)) & set("#%_~^<>|")
    assert re.findall(r"\\(?:begin|end)\{tabular\}", body) == [r"\begin{tabular}", r"\end{tabular}"]
    assert [re.search(rf"\\{rule}rule", body) is not None for rule in ("top", "mid", "bottom")] == [True] * 3
    alignment = re.search(r"\{tabular\}\{([lr]+)\}", body)
    assert alignment
    assert len(alignment[1]) == columns
    lines = [line for line in body.splitlines() if line.endswith(r" \\")]
    cells = [re.split(r"(?<!\\)&", line.removesuffix(r" \\")) for line in lines]
    assert [len(line) for line in cells] == [columns] * (1 + rows)
    return [[cell.strip() for cell in line] for line in cells]


def test_any_text_is_valid() -> None:
    rows = [(text, 1.5, None) for text in TEXTS]
    cells = check(latex_table(Table("Errors\n100 %", ("a_b & c", "RMSE (cm)", "NEES/n"), rows)), 3, len(rows))
    assert cells[0] == [r"a\_b \& c", "RMSE (cm)", "NEES/n"]
    assert cells[4][0] == r"a \textrightarrow{} b c"
    assert cells[2][0] == r"hinge\_x \& 50 \% \{of\} \$5"


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (12.3456, "$12.3$"),
        (-0.00123456, "$-0.00123$"),
        (1234.5, "$1234$"),
        (1.2e-9, r"$1.20 \cdot 10^{-9}$"),
        (-7, "$-7$"),
        (Probability(0.5), "$0.50$"),
        (Probability(0.999), "above 0.99"),
        (True, "True"),
        (float("nan"), "--"),
        (None, "--"),
    ],
)
def test_numbers_have_the_digits_of_the_page(value: float | None, expected: str) -> None:
    line = latex_table(Table("t", ("n",), [(value,)])).splitlines()[5]
    assert line == f"{expected} \\\\"


def test_a_table_without_rows_is_valid() -> None:
    check(latex_table(Table("t", ("a", "b"), [])), 2, 0)

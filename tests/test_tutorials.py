"""The tutorials run and print what they document."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

TOOL = runpy.run_path(str(Path(__file__).resolve().parents[1] / "tools" / "tutorials.py"))
LONG = ("failure_to_repair", "own_study")


def tutorials() -> list[Any]:
    pages = sorted(TOOL["FOLDER"].glob("*.md"))
    assert len(pages) == 4
    return [pytest.param(p, id=p.stem, marks=pytest.mark.long if p.stem in LONG else ()) for p in pages]


@pytest.mark.parametrize("page", tutorials())
def test_outputs_are_as_documented(page: Path) -> None:
    documented = TOOL["Tutorial"].read(page)
    assert documented.markdown() == page.read_text()
    measured = documented.executed()
    assert not TOOL["differences"](documented, measured)
    for cell in measured.cells:
        assert not cell.figure or (page.parent / cell.figure).stat().st_size > 1000
    notebook = json.loads(json.dumps(measured.notebook()))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["source"] + "\n" for cell in code] == [cell.code for cell in documented.cells]
    assert any(cell["outputs"] for cell in code)


def test_wrong_outputs_are_found() -> None:
    read, cell = TOOL["Tutorial"], TOOL["Cell"]
    old, new = (read("t", (cell("", "x", text),), "") for text in ("error 1.20 cm\n", "error 1.40 cm\n"))
    assert TOOL["differences"](old, new) == ["t, cell 1: documented 1.20, measured 1.40"]
    assert not TOOL["differences"](old, old)
    assert TOOL["differences"](old, read("t", (cell("", "x", "no error\n"),), ""))

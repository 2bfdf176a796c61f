"""Runs the tutorials, Markdown pages with Python cells, and converts them to notebooks.

python tools/tutorials.py                    run all; write outputs and figures into the pages
python tools/tutorials.py inspect_a_run      only this one
python tools/tutorials.py --notebooks FOLDER also write FOLDER/NAME.ipynb with the outputs

A cell is a ```python block; the ```text block behind it is its output, the image behind it its figure. Cells of a page
share their names and a temporary working directory, as in a notebook.
"""

from __future__ import annotations

import argparse
import ast
import base64
import contextlib
import io
import json
import linecache
import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "tutorials"

CELL = re.compile(
    r"^```python\n(?P<code>.*?)^```\n(?:\n```text\n(?P<output>.*?)^```\n)?(?:\n!\[(?P<caption>.*?)\]\((?P<figure>.*?)\)\n)?",
    re.DOTALL | re.MULTILINE,
)
EMBEDDED = re.compile(r'src="data:image/png;base64,([^"]+)"')
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
DOTS_PER_INCH = 100


@dataclass(frozen=True)
class Cell:
    """A cell with its documented or measured output.

    Attributes:
        before: text in front of it. output: text; empty if there is none. caption, figure: of the image; empty if
        there is none. html, png: other forms of the output, of an executed cell.
    """

    before: str
    code: str
    output: str = ""
    caption: str = ""
    figure: str = ""
    html: str = ""
    png: bytes = b""

    def markdown(self) -> str:
        text = f"{self.before}```python\n{self.code}```\n"
        if self.output:
            text += f"\n```text\n{self.output}```\n"
        if self.figure:
            text += f"\n![{self.caption}]({self.figure})\n"
        return text


@dataclass(frozen=True)
class Tutorial:
    """A page: its cells, and the text after the last one."""

    name: str
    cells: tuple[Cell, ...]
    after: str

    @classmethod
    def read(cls, path: Path) -> Tutorial:
        text, end, cells = path.read_text(), 0, []
        for match in CELL.finditer(text):
            parts = {name: match[name] or "" for name in ("code", "output", "caption", "figure")}
            cells.append(Cell(text[end : match.start()], **parts))
            end = match.end()
        return cls(path.stem, tuple(cells), text[end:])

    def markdown(self) -> str:
        return "".join(cell.markdown() for cell in self.cells) + self.after

    def executed(self) -> Tutorial:
        """The tutorial with measured outputs."""
        names: dict[str, Any] = {"__name__": "__main__"}
        with in_temporary_folder():
            cells = [self._run(cell, number, names) for number, cell in enumerate(self.cells, 1)]
        return replace(self, cells=tuple(cells))

    def _run(self, cell: Cell, number: int, names: dict[str, Any]) -> Cell:
        place = f"<{self.name}, cell {number}>"
        linecache.cache[place] = (len(cell.code), None, cell.code.splitlines(True), place)  # for inspect.getsource
        tree = ast.parse(cell.code, place)
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        printed, value = io.StringIO(), None
        with contextlib.redirect_stdout(printed):
            exec(compile(tree, place, "exec"), names)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), place, "eval"), names)
        cell = replace(cell, output=printed.getvalue(), figure="", html="", png=b"")
        path = f"images/{self.name}-{number}.png"
        if hasattr(value, "savefig"):
            drawn = io.BytesIO()
            value.savefig(drawn, format="png", dpi=DOTS_PER_INCH)
            return replace(cell, figure=path, caption=cell.caption or "Figure", png=drawn.getvalue())
        if value is None:
            return cell
        html = value._repr_html_() if hasattr(value, "_repr_html_") else ""
        if image := EMBEDDED.search(html):
            return replace(
                cell, figure=path, caption=cell.caption or "Figure", html=html, png=base64.b64decode(image[1])
            )
        return replace(cell, output=f"{cell.output}{value!r}\n", html=html)

    def notebook(self) -> dict[str, Any]:
        """The tutorial as a notebook, version 4.5 of the format."""
        cells: list[dict[str, Any]] = []
        for number, cell in enumerate(self.cells, 1):
            if cell.before.strip():
                cells.append({"cell_type": "markdown", "source": cell.before.strip(), "metadata": {}})
            code = {"cell_type": "code", "source": cell.code.rstrip(), "metadata": {}, "execution_count": number}
            cells.append(code | {"outputs": _outputs(cell, number)})
        if self.after.strip():
            cells.append({"cell_type": "markdown", "source": self.after.strip(), "metadata": {}})
        cells = [cell | {"id": f"cell-{i}"} for i, cell in enumerate(cells)]
        kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
        return {"nbformat": 4, "nbformat_minor": 5, "metadata": {"kernelspec": kernel}, "cells": cells}


def _outputs(cell: Cell, number: int) -> list[dict[str, Any]]:
    if not cell.png and not cell.html:
        return [{"output_type": "stream", "name": "stdout", "text": cell.output}] if cell.output else []
    data = {"text/html": cell.html} if cell.html else {"image/png": base64.b64encode(cell.png).decode()}
    data["text/plain"] = cell.output.rstrip() or cell.caption
    return [{"output_type": "execute_result", "execution_count": number, "data": data, "metadata": {}}]


@contextlib.contextmanager
def in_temporary_folder() -> Iterator[None]:
    """Work in a temporary folder; figures need no display."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)


def differences(documented: Tutorial, measured: Tutorial, tolerance: float = 0.05) -> list[str]:
    """Cells whose output differs in text, or in a number by more than the relative tolerance and its last digit."""
    problems = []
    for number, (old, new) in enumerate(zip(documented.cells, measured.cells, strict=True), 1):
        place = f"{documented.name}, cell {number}"
        if NUMBER.sub("#", old.output).split() != NUMBER.sub("#", new.output).split() or old.figure != new.figure:
            problems.append(f"{place}: documented {old.output or old.figure!r}, measured {new.output or new.figure!r}")
            continue
        for expected, actual in zip(NUMBER.findall(old.output), NUMBER.findall(new.output), strict=True):
            digit = 10.0 ** -len(expected.partition(".")[2])
            if abs(float(expected) - float(actual)) > max(digit, tolerance * abs(float(expected))):
                problems.append(f"{place}: documented {expected}, measured {actual}")
    return problems


def write(tutorial: Tutorial, notebooks: Path | None) -> None:
    """Write the page with its figures, and a notebook."""
    (FOLDER / f"{tutorial.name}.md").write_text(tutorial.markdown())
    for cell in tutorial.cells:
        if cell.png:
            (FOLDER / cell.figure).write_bytes(cell.png)
    if notebooks is not None:
        notebooks.mkdir(parents=True, exist_ok=True)
        (notebooks / f"{tutorial.name}.ipynb").write_text(json.dumps(tutorial.notebook(), indent=1) + "\n")


def main() -> None:
    pages = sorted(path.stem for path in FOLDER.glob("*.md"))
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"default: {', '.join(pages)}")
    parser.add_argument("--notebooks", type=Path, metavar="FOLDER", help="also write notebooks")
    args = parser.parse_args()
    for name in args.names or pages:
        write(Tutorial.read(FOLDER / f"{name}.md").executed(), args.notebooks and args.notebooks.resolve())


if __name__ == "__main__":
    main()

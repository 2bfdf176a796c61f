"""``beliefscope lineage``"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import Json, check
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from rich.tree import Tree

    from beliefscope.inspect.compare.lineage import Ancestor, Lineage


def lineage(
    places: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Where checkpoints are; files too.")],
    export: Annotated[
        str | None,
        typer.Option(
            "--export", metavar="CHECKPOINT", help="Copy this one, by file or hash, with its ancestors to -o."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", metavar="DIR", help="New folder for --export.")] = None,
    json: Json = None,
) -> None:
    """Show which checkpoint was made from which.

    The tree of all checkpoints in these folders, as their own headers tell it, with the command that made each and its
    RMSE. --export writes one with its ancestors, their numbers and hashes into a folder that a colleague can use.
    Two of them are held against each other by beliefscope change.

    \b
    Examples:
      beliefscope lineage runs
      beliefscope lineage runs --json -
      beliefscope lineage runs --export child.safetensors -o for-a-colleague
    """
    from beliefscope import __version__
    from beliefscope.inspect.compare.lineage import export as copy
    from beliefscope.inspect.compare.lineage import lineage_of

    check(None, json)
    if (export is None) != (output is None):
        raise BadInput("--export and -o belong together: which checkpoint, and the folder that it is copied to")
    found = lineage_of(places)
    for line in found.left_out:
        console.say(f"left out: {line}")
    if export is None or output is None:
        console.result(found.to_dict(), drawn(found), json)
        return
    one = found.find(export)
    files = copy(found, one.hash, output, __version__)
    document = {"checkpoint": one.hash, "path": str(output), "files": [path.name for path in files]}
    console.result(document, "\n".join([f"{output}:", *(f"  {path.name}" for path in files)]), json)


def drawn(found: Lineage) -> str:
    """The trees, a root each."""
    from rich.console import Console
    from rich.text import Text
    from rich.tree import Tree

    view = Console(width=1000, color_system=None)
    with view.capture() as capture:
        for root in found.roots:
            tree = Tree(Text(_line(root, orphan=root.parent is not None)))
            _grow(tree, found, root)
            view.print(tree)
    return "\n".join(line.rstrip() for line in capture.get().rstrip().splitlines())


def _grow(tree: Tree, found: Lineage, of: Ancestor) -> None:
    from rich.text import Text

    for child in found.children(of.hash):
        _grow(tree.add(Text(_line(child))), found, child)


def _line(one: Ancestor, orphan: bool = False) -> str:
    numbers = ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in one.rmse.items())
    parts = [f"{one.path} {one.hash[:12]} {one.task} {one.name}"]
    data = one.record.get("data_hash")  # numbers on other data do not compare
    parts += [f"RMSE {numbers}{f', data {data[:12]}' if data else ''}"] if numbers else []
    parts += [one.command] if one.command else []
    parts += [f"made from {str(one.parent)[:12]}, which is not here"] if orphan else []
    return "\n".join(parts)

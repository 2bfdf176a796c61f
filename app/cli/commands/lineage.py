"""``beliefscope lineage``"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output as console
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from rich.tree import Tree

    from beliefscope.inspect.compare.lineage import Ancestor, Lineage


def lineage(
    paths: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Folders with checkpoints, or checkpoints.")],
    export: Annotated[
        str | None,
        typer.Option(metavar="CHECKPOINT", help="Copy this checkpoint (path or hash) and its ancestors to -o."),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", metavar="DIR", help="New folder for --export.")] = None,
    json: opt.Json = None,
) -> None:
    """Show which checkpoint was fine-tuned from which.

    Prints the tree of all checkpoints in the folders, based on their headers, with the command that created each one
    and its RMSE. --export writes a checkpoint with its ancestors, their metrics and hashes to a folder for sharing.
    Compare two checkpoints with beliefscope change.

    \b
    Examples:
      beliefscope lineage runs
      beliefscope lineage runs --json -
      beliefscope lineage runs --export finetuned.safetensors -o shared
    """
    from beliefscope import __version__
    from beliefscope.inspect.compare.lineage import export as copy
    from beliefscope.inspect.compare.lineage import lineage_of

    if (export is None) != (output is None):
        raise BadInput("--export and -o must be given together: the checkpoint, and the folder to copy it to")
    checkpoints = lineage_of(paths)
    for line in checkpoints.left_out:
        console.note(f"skipped: {line}")
    if export is None or output is None:
        console.result(checkpoints.to_dict(), _render(checkpoints), json)
        return
    checkpoint = checkpoints.find(export)
    files = copy(checkpoints, checkpoint.hash, output, __version__)
    document = {"checkpoint": checkpoint.hash, "path": str(output), "files": [path.name for path in files]}
    console.result(document, "\n".join([f"{output}:", *(f"  {path.name}" for path in files)]), json)


def _render(checkpoints: Lineage) -> str:
    """One tree per root."""
    from rich.text import Text
    from rich.tree import Tree

    trees = []
    for root in checkpoints.roots:
        trees.append(Tree(Text(_label(root, orphan=root.base is not None))))
        _add_children(trees[-1], checkpoints, root)
    return console.render(*trees)


def _add_children(tree: Tree, checkpoints: Lineage, parent: Ancestor) -> None:
    from rich.text import Text

    for child in checkpoints.finetuned(parent.hash):
        _add_children(tree.add(Text(_label(child))), checkpoints, child)


def _label(checkpoint: Ancestor, orphan: bool = False) -> str:
    errors = ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in checkpoint.rmse.items())
    lines = [f"{checkpoint.path} {checkpoint.hash[:12]} {checkpoint.task} {checkpoint.name}"]
    data = checkpoint.record.get("data_hash")  # Errors on different data are not comparable.
    lines += [f"RMSE {errors}{f', data {data[:12]}' if data else ''}"] if errors else []
    lines += [checkpoint.command] if checkpoint.command else []
    lines += [f"fine-tuned from {str(checkpoint.base)[:12]}, which is not in these folders"] if orphan else []
    return "\n".join(lines)

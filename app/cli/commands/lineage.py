from pathlib import Path

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput


def lineage(
    paths: list[Path] = opt.argument("FOLDER...", "Checkpoints, or folders with checkpoints."),
    export: str | None = opt.option(
        "CHECKPOINT", "Copy this checkpoint (path or hash) and its ancestors to the folder of -o.", None
    ),
    output: Path | None = opt.option("DIR", "New folder for --export.", None, "-o"),
) -> console.Result:
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
    from beliefscope.inspect.compare.lineage import export as copy, lineage_of

    if (export is None) != (output is None):
        raise BadInput("--export and -o must be given together: the checkpoint, and the folder to copy it to")
    checkpoints = lineage_of(paths)
    for line in checkpoints.left_out:
        console.note(f"skipped: {line}")
    if export is None or output is None:
        return console.Result(checkpoints.to_dict(), str(checkpoints))
    checkpoint = checkpoints.find(export)
    files = copy(checkpoints, checkpoint.hash, output, __version__)
    document = {"checkpoint": checkpoint.hash, "path": str(output), "files": [path.name for path in files]}
    return console.Result(document, "\n".join([f"{output}:", *(f"  {path.name}" for path in files)]))

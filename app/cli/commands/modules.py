"""``beliefscope modules``"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import output
from beliefscope.app.cli.options import FilterName, Json, TaskName, check, checkpoint, whole

if TYPE_CHECKING:
    from beliefscope.filters.finetuning.module_selection import Node

Freeze = Annotated[
    list[str] | None,
    typer.Option(
        "--freeze",
        metavar="PATTERN",
        help="Leave these parts as they are: dotted names, * for any text. May be given several times.",
    ),
]
Train = Annotated[
    list[str] | None,
    typer.Option(
        "--train",
        "--preset",
        metavar="PRESET|PATTERN",
        help="Train only these: haptics-only, image-only, weights-only, noise-only, dynamics-only, heads-only, all, or "
        "patterns. May be given several times. Without it: all that is not frozen.",
    ),
]


def modules(
    task: TaskName,
    filter_: FilterName,
    train: Train = None,
    freeze: Freeze = None,
    depth: Annotated[int, typer.Option("--depth", parser=whole(0), metavar="N", help="So many levels.")] = 3,
    json: Json = None,
) -> None:
    """Show what a filter is made of.

    Every module by its dotted name, with its number of parameters, whether beliefscope finetune would train it with
    the same options, and what it does. Of a fine-tuned filter also what its training did: the gradient's size, and how
    far the weights went.

    \\b
    Examples:
      beliefscope modules door --filter crossmodal-ekf
      beliefscope modules door --filter crossmodal-pf --train haptics-only --train weights-only
      beliefscope modules door --filter crossmodal-ekf --freeze 'virtual_sensors.image' --freeze dynamics --json -
    """
    from beliefscope.filters.external.load import Foreign
    from beliefscope.filters.finetuning.module_selection import chosen, presets, tree

    check(None, json)
    loaded = checkpoint(task, filter_)
    module = loaded.adapter.module if isinstance(loaded, Foreign) else loaded.filter
    nodes, named = tree(module, chosen(module, train or (), freeze or ())), presets(module)
    ran = loaded.record.get("parts", {})
    document = {
        "task": task,
        "filter": loaded.name,
        "checkpoint_hash": loaded.hash,
        "presets": {name: list(patterns) for name, patterns in named.items()},
        "modules": [_as_json(node, ran) for node in nodes],
    }
    what = f"{loaded.name} ({loaded.hash[:12]}): {nodes[0].parameters:,} parameters"
    lines = [what, "", text([node for node in nodes if node.depth <= depth], ran), "", "Presets for --train"]
    lines += [f"  {name}: {', '.join(patterns)}" for name, patterns in named.items()]
    output.result(document, "\n".join(lines), json)


def _as_json(node: Node, ran: dict[str, list[float]]) -> dict[str, object]:
    from beliefscope.filters.finetuning.module_selection import moved

    values = {"name": node.name, "class": node.kind, "says": node.says, "parameters": node.parameters}
    return values | {"buffers": node.buffers, "trained": node.trained, "state": node.state} | moved(node.name, ran)


def text(nodes: list[Node], ran: dict[str, list[float]]) -> str:
    """The tree, with columns that fit it."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from beliefscope.filters.finetuning.module_selection import moved

    grid = Table(box=SIMPLE_HEAD, pad_edge=False)
    for name in ("module", "class"):
        grid.add_column(name, no_wrap=True)
    grid.add_column("parameters", justify="right")
    grid.add_column("state")
    for name in ("gradient", "change") if ran else ():
        grid.add_column(name, justify="right")
    grid.add_column("what it does", no_wrap=True)
    for node in nodes:
        label = Text("  " * node.depth + (node.name.rpartition(".")[2] or "(filter)"))
        size = f"{node.parameters:,}" if node.parameters else f"{node.buffers:,} fixed" if node.buffers else ""
        row: list[str | Text] = [label, node.kind, size, node.state]
        if ran:
            found = moved(node.name, ran)
            row += [
                f"{found['gradient']:.2g}" if found["gradient"] else "-",
                f"{100 * found['change']:.2g} %" if found["change"] else "-",
            ]
        grid.add_row(*row, Text(node.says))
    view = Console(width=1000, color_system=None)
    with view.capture() as capture:
        view.print(grid)
    return "\n".join(line.rstrip() for line in capture.get().strip("\n").splitlines())

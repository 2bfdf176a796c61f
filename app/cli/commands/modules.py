"""``beliefscope modules``"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output

if TYPE_CHECKING:
    from beliefscope.filters.finetuning.module_selection import Node

Freeze = Annotated[
    list[str] | None,
    typer.Option(metavar="PATTERN", help="Freeze these modules: dotted names, * matches any text. Repeatable."),
]
Train = Annotated[
    list[str] | None,
    typer.Option(
        metavar="PRESET|PATTERN",
        help="Train only these modules: haptics-only, image-only, weights-only, noise-only, dynamics-only, heads-only, "
        "all, or patterns. Repeatable. Default: all modules that are not frozen.",
    ),
]


def modules(
    task: opt.TaskName,
    filter_: opt.FilterName,
    train: Train = None,
    freeze: Freeze = None,
    depth: Annotated[int, typer.Option(parser=opt.integer(0), metavar="N", help="Levels to print.")] = 3,
    json: opt.Json = None,
) -> None:
    """Show the modules of a filter.

    Lists every module by its dotted name with its number of parameters, its purpose, and whether beliefscope finetune
    with the same options would train it. For a fine-tuned filter, also lists the gradient norm and the relative change
    of the weights.

    \b
    Examples:
      beliefscope modules door --filter crossmodal-ekf
      beliefscope modules door --filter crossmodal-pf --train haptics-only --train weights-only
      beliefscope modules door --filter crossmodal-ekf --freeze 'virtual_sensors.image' --freeze dynamics --json -
    """
    from beliefscope.filters.external.load import ExternalFilter
    from beliefscope.filters.finetuning.module_selection import module_change, module_tree, presets, select_parameters

    checkpoint = opt.open_checkpoint(task, filter_)
    module = checkpoint.adapter.module if isinstance(checkpoint, ExternalFilter) else checkpoint.filter
    nodes, groups = module_tree(module, select_parameters(module, train or (), freeze or ())), presets(module)
    parts = checkpoint.record.get("parts", {})
    document = {
        "task": task,
        "filter": checkpoint.name,
        "checkpoint_hash": checkpoint.hash,
        "presets": {name: list(patterns) for name, patterns in groups.items()},
        "modules": [
            {
                "name": node.name,
                "class": node.kind,
                "description": node.description,
                "parameters": node.parameters,
                "buffers": node.buffers,
                "trained": node.trained,
                "state": node.state,
            }
            | module_change(node.name, parts)
            for node in nodes
        ],
    }
    lines = [f"{checkpoint.name} ({checkpoint.hash[:12]}): {nodes[0].parameters:,} parameters", ""]
    lines += [_table([node for node in nodes if node.depth <= depth], parts), "", "Presets for --train"]
    lines += [f"  {name}: {', '.join(patterns)}" for name, patterns in groups.items()]
    output.result(document, "\n".join(lines), json)


def _table(nodes: list[Node], parts: dict[str, list[float]]) -> str:
    """The module tree as a table. parts: gradient and weight change by parameter, if fine-tuned."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    from beliefscope.filters.finetuning.module_selection import module_change

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for name in ("module", "class"):
        table.add_column(name, no_wrap=True)
    table.add_column("parameters", justify="right")
    table.add_column("state")
    for name in ("gradient", "change") if parts else ():
        table.add_column(name, justify="right")
    table.add_column("purpose", no_wrap=True)
    for node in nodes:
        label = Text("  " * node.depth + (node.name.rpartition(".")[2] or "(filter)"))
        size = f"{node.parameters:,}" if node.parameters else f"{node.buffers:,} fixed" if node.buffers else ""
        row: list[str | Text] = [label, node.kind, size, node.state]
        if parts:
            change = module_change(node.name, parts)
            row += [
                f"{change['gradient']:.2g}" if change["gradient"] else "-",
                f"{100 * change['change']:.2g} %" if change["change"] else "-",
            ]
        table.add_row(*row, Text(node.description))
    return output.render(table)

from beliefscope.app.cli import console, options as opt


def modules(
    task: str,
    filter: str,
    train: list[str] | None = None,
    freeze: list[str] | None = None,
    depth: int = opt.option("N", "Levels to print.", 3, parser=opt.integer(0)),
) -> console.Result:
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
    from beliefscope.filters.finetuning.report import module_table
    from beliefscope.filters.open_filter import open_filter
    from beliefscope.inspect.diagnostics.views import format_table

    checkpoint = open_filter(task, filter)
    module = checkpoint.adapter.module if isinstance(checkpoint, ExternalFilter) else checkpoint.filter
    nodes, groups = module_tree(module, select_parameters(module, train or (), freeze or ())), presets(module)
    parts = checkpoint.record.get("parts", {})
    document = {
        "task": task,
        "filter": checkpoint.name,
        "checkpoint_hash": checkpoint.hash,
        "presets": {name: list(patterns) for name, patterns in groups.items()},
        "modules": [node.to_json() | module_change(node.name, parts) for node in nodes],
    }
    title = f"{checkpoint.name} ({checkpoint.hash[:12]}): {nodes[0].parameters:,} parameters"
    lines = [format_table(title, *module_table(nodes, parts, depth)), "", "Presets for --train"]
    lines += [f"  {name}: {', '.join(patterns)}" for name, patterns in groups.items()]
    return console.Result(document, "\n".join(lines))

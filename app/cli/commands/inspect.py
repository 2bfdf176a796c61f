from pathlib import Path
from typing import Literal

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput, check_name


def inspect(
    paths: list[Path] = opt.argument("TRACE|DIR...", "Traces of one filter, or folders of them."),
    filter: str = opt.TRACE_FILTER,
    task: str = opt.TASK_OF_FILES,
    only: list[str] | None = opt.option("NAME", "Run only this diagnostic. Repeatable.", None),
    options: list[str] | None = opt.option(
        "NAME=VALUE", "Option of a diagnostic, such as step=68. Repeatable.", None, "--option"
    ),
    every: bool = opt.flag("Include slow diagnostics.", "--all"),
    figures: Path | None = opt.option("DIR", "Write a figure per diagnostic to this folder.", None),
    format: Literal["svg", "pdf", "png"] = opt.option("NAME", "Format of the figures: svg, pdf or png.", "svg"),
) -> console.Result:
    """Run diagnostics on traces of a filter.

    Prints the verdict and tables of every applicable diagnostic, and why the others do not apply. Several traces of
    one filter count as independent episodes, which allows bounds and confidence intervals. Details:
    docs/diagnostics.md.

    \b
    Examples:
      beliefscope inspect run.trace
      beliefscope inspect runs --only consistency --figures figures --format pdf
      beliefscope inspect run.trace --only saliency --option step=68 --option target=beta:image
      beliefscope inspect run.trace --filter mine.safetensors --all --json -
    """
    from beliefscope.inspect.catalog import DIAGNOSTICS, reason_text, run_diagnostics
    from beliefscope.inspect.diagnostics.plotting import write_figure
    from beliefscope.recordings.open_trace import open_traces, run_files

    for name in only or ():
        check_name("diagnostic", name, DIAGNOSTICS)
    entries = {name: entry for name, entry in DIAGNOSTICS.items() if not only or name in only}
    values = opt.key_values(options or (), "--option", "NAME=VALUE, such as step=68")
    available = sorted({name for entry in entries.values() for name in entry.options})
    for name in values:
        check_name("option", name, available)
    parsed = {
        name: entry.parse_options({option: values[option] for option in entry.options if option in values})
        for name, entry in entries.items()
    }
    opt.check_folder(figures, "--figures")
    paths = [file for path in paths for file in run_files(path) or [path]]
    traces, checkpoint = open_traces(paths, filter, task)
    with console.progress("Inspecting") as advance:
        results, reasons = run_diagnostics(traces, checkpoint, parsed, bool(every or only), advance)
    if not results:
        raise BadInput("; ".join(dict.fromkeys(reasons.values())))
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        for name, result in results.items():
            if (figure := result.plot(traces[0].episode.time)).axes:  # of several traces, some have tables only
                write_figure(figure, figures / f"{name}.{format}")
    text = [f"{DIAGNOSTICS[name].title}: {result.text}" for name, result in results.items()]
    text += [f"{DIAGNOSTICS[name].title}: {reason_text(reason)}" for name, reason in reasons.items()]
    document = {
        "task": traces[0].task.name,
        "filter": traces[0].filter,
        "checkpoint_hash": traces[0].checkpoint_hash,
        "traces": [{"path": str(p), "episode": t.episode_index} for p, t in zip(paths, traces, strict=True)],
        "diagnostics": {name: result.to_dict() for name, result in results.items()},
        "not_made": reasons,
    }
    return console.Result(document, "\n\n".join(text))

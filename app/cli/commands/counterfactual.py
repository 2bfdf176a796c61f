"""``beliefscope counterfactual``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import (
    DataPath,
    EpisodeIndex,
    FaultsText,
    FilterName,
    Json,
    Particles,
    Seed,
    SkipBad,
    TaskName,
    check,
    checkpoint,
    faults,
    one_episode,
    whole,
)
from beliefscope.datasets.errors import BadInput


def counterfactual(
    task: TaskName,
    filter_: FilterName,
    first: Annotated[int, typer.Option("--from", parser=whole(0), metavar="STEP", help="First step of the edit.")],
    to: Annotated[int, typer.Option("--to", parser=whole(1), metavar="STEP", help="First step after the edit.")],
    data: DataPath = None,
    skip_bad: SkipBad = False,
    episode: EpisodeIndex = None,
    faults_: FaultsText = "",
    weights: Annotated[
        str,
        typer.Option(
            "--weights",
            metavar="MODALITY=BETA,...",
            help="Fusion weights in place of the network's; modalities that are not named share the rest.",
        ),
    ] = "",
    particles: Particles = 300,
    seed: Seed = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FIGURE", help="A figure: .svg, .pdf or .png.")
    ] = None,
    trace_path: Annotated[
        Path | None, typer.Option("--trace", metavar="TRACE", help="Write the edited run's trace.")
    ] = None,
    json: Json = None,
) -> None:
    """Edit a sensor for a while and run again.

    From the belief before the edit's first step on, with the same random numbers at every step as the run without the
    edit, so that all that differs comes from the edit. Says how far the estimate moved, in cm and in the original's
    own standard deviations, when it was back, and which modality decided meanwhile. --weights edits beta instead.
    Faults are written as elsewhere, but without a span of their own.

    \b
    Examples:
      beliefscope counterfactual door --filter crossmodal-pf --faults blackout --from 40 --to 60
      beliefscope counterfactual door --filter crossmodal-ekf --weights image=0.1 --from 40 --to 60 -o weights.svg
      beliefscope counterfactual push --filter crossmodal-pf --faults force_bias=5 --from 20 --to 50 --trace off.trace
    """
    from beliefscope.inspect.compare.counterfactual import compare
    from beliefscope.inspect.diagnostics.plotting import figure_format, write_figure
    from beliefscope.inspect.trace import save_trace, trace
    from beliefscope.inspect.traces.replay import Edit, Replay, betas

    check(output, json)
    check(trace_path, json)
    if output is not None:
        figure_format(output)
    loaded = checkpoint(task, filter_)
    edit = Edit(first, to, faults(faults_, loaded.task), betas(weights))
    if not edit.faults and not edit.weights:
        raise BadInput("nothing is edited: give --faults, --weights or both")
    shown, index = one_episode(loaded.task, data, skip_bad, episode)
    with console.progress("Filtering") as advance:
        made = trace(loaded, shown, index, seed, particles)
        replay = Replay(loaded, made, progress=advance)
        edited = replay.edited(edit)
    result = compare(replay.original, edited, edit)
    if output is not None:
        write_figure(result.plot(), output)
    if trace_path is not None:
        save_trace(edited, trace_path)
    document = {
        "task": loaded.task.name,
        "filter": loaded.name,
        "episode": index,
        "edit": edit.to_json(),
        "seed": seed,
        "checkpoint_hash": loaded.hash,
        "data_hash": made.data_hash,
        **result.to_dict(),
    }
    tables = [console.grid(one.title, one.columns, one.rows) for one in result.tables()]
    console.result(document, "\n\n".join([result.verdict, *tables]), json)

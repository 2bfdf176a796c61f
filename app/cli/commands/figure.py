"""``beliefscope figure``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

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
    described,
    one_run,
    title,
    whole,
)
from beliefscope.datasets.errors import BadInput, one_of

KINDS = ("maps", "weights")


def figure(
    kind: Annotated[str, typer.Argument(metavar="maps|weights", help="Which of the two figures.")],
    task: TaskName,
    filter_: FilterName,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FIGURE", help="A figure: .svg, .pdf or .png.")],
    data: DataPath = None,
    skip_bad: SkipBad = False,
    episode: EpisodeIndex = None,
    steps: Annotated[
        list[int] | None,
        typer.Option(
            "--step",
            parser=whole(0),
            metavar="T",
            help="Of the maps, in place of the middle of the longest stretch: one in contact, one not, or both by "
            "giving it twice.",
        ),
    ] = None,
    faults_: FaultsText = "",
    particles: Particles = 300,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Draw a figure of the paper from a filter's run.

    maps: the likelihood of each modality over the square about the truth, of touch without contact and in contact.
    weights: each modality's and the fused estimate over the steps, and the fusion weights below, with contact behind.

    \b
    Examples:
      beliefscope figure maps door --filter crossmodal-pf -o maps.svg
      beliefscope figure weights push --filter crossmodal-ekf --episode 9 -o weights.pdf
    """
    from beliefscope.inspect.diagnostics.plotting import figure_format, write_figure
    from beliefscope.inspect.figures import paper
    from beliefscope.inspect.likelihood import no_maps

    check(output, json)
    if kind not in KINDS:
        raise one_of("figure", kind, KINDS)
    figure_format(output)
    if kind == "weights" and steps:
        raise BadInput(f"--step {steps[0]}: the weights are drawn over all steps; only maps have a step")
    loaded, made = one_run(task, filter_, data, skip_bad, episode, faults_, particles, seed)
    document: dict[str, Any] = {"figure": kind}
    if kind == "maps":
        if why := no_maps(loaded, made):
            raise BadInput(why)
        chosen = paper.steps_by_contact(made, steps or ())
        if False not in chosen:
            console.say(f"episode {made.episode_index} is in contact at every step: no map without")
        write_figure(paper.maps_figure(loaded, made, chosen), output)
        document["shown"] = {paper.STATES[state]: step for state, step in chosen.items()}
    else:
        write_figure(paper.weights_figure(made), output)
    console.result(document | described(made, output), title(made, output), json)

"""``beliefscope record``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app import console
from beliefscope.app.commands.given import (
    DataPath,
    EpisodeIndex,
    FilterName,
    Json,
    Particles,
    RecipeText,
    Seed,
    SkipBad,
    TaskName,
    check,
    checkpoint,
    described,
    recipe,
    title,
    traced,
    whole,
)


def record(
    task: TaskName,
    filter_: FilterName,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN.rrd", help="Where to write the recording.")],
    data: DataPath = None,
    skip_bad: SkipBad = False,
    episode: EpisodeIndex = None,
    maps: Annotated[
        int,
        typer.Option(
            "--maps", parser=whole(0), metavar="STRIDE", help="Likelihood maps of each STRIDE-th step; 0: none."
        ),
    ] = 10,
    recipe_: RecipeText = "",
    particles: Particles = 300,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Write one episode as a Rerun recording.

    Pictures, particles or ellipses, estimates beside the truth, fusion weights, contact, errors and likelihood
    maps, with their layout. Open it with: rerun run.rrd.

    \b
    Examples:
      beliefscope record door --filter crossmodal-ekf --episode 9 --maps 5 -o run.rrd
      beliefscope record door --filter crossmodal-pf --recipe image_frozen=20 -o frozen.rrd
    """
    from beliefscope.inspect.likelihood import MapEngine, no_maps
    from beliefscope.recordings.write import write_recording

    check(output, json)
    loaded = checkpoint(task, filter_)
    made = traced(loaded, data, episode, recipe(recipe_, loaded.task), particles, seed, skip_bad)
    if maps and (why := no_maps(loaded)):
        console.say(f"without maps: {why}")
        maps = 0
    layers = MapEngine(loaded, made).maps(range(0, len(made), maps)) if maps else None
    with console.progress("Recording") as advance:
        write_recording(made, output, maps=layers, progress=advance)
    console.result(described(made, output) | {"maps": maps}, title(made, output), json)

"""``beliefscope trace``"""

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
)


def trace(
    task: TaskName,
    filter_: FilterName,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="TRACE", help="Where to write the trace.")],
    data: DataPath = None,
    skip_bad: SkipBad = False,
    episode: EpisodeIndex = None,
    recipe_: RecipeText = "",
    particles: Particles = 300,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Keep all a filter knew, step by step.

    Beliefs before and after each observation, what each modality alone believes, fusion weights as the network gave
    them and as they acted, particles and their ancestors. The estimates are bit-identical to those of a run that
    keeps nothing. In Python: beliefscope.inspect.trace.load_trace.

    \b
    Examples:
      beliefscope trace door --filter crossmodal-pf --episode 9 -o run.trace
      beliefscope trace door --filter crossmodal-pf --recipe force_bias:x=5:from=20 -o biased.trace
    """
    from beliefscope.inspect.trace import save_trace

    check(output, json)
    loaded = checkpoint(task, filter_)
    made = traced(loaded, data, episode, recipe(recipe_, loaded.task), particles, seed, skip_bad)
    save_trace(made, output)
    console.result(described(made, output), title(made, output), json)

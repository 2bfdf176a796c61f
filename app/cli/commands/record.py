"""``beliefscope record``"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import Json, described, of_one_run, title, whole

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace


@of_one_run
def record(
    checkpoint: Checkpoint,
    made: Trace,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN.rrd", help="Where to write the recording.")],
    maps: Annotated[
        int,
        typer.Option(
            "--maps", parser=whole(0), metavar="STRIDE", help="Likelihood maps of each STRIDE-th step; 0: none."
        ),
    ] = 10,
    map_size: Annotated[
        int, typer.Option("--map-size", parser=whole(2, 1024), metavar="S", help="Cells along a side of each map.")
    ] = 135,
    diagnostics: Annotated[
        bool,
        typer.Option(
            "--diagnostics/--no-diagnostics", help="With every diagnostic that applies and is not slow, a tab for each."
        ),
    ] = True,
    json: Json = None,
) -> None:
    """Write one episode as a Rerun recording.

    Pictures, particles or ellipses, estimates beside the truth, fusion weights, contact, errors, likelihood maps and
    diagnostics, with their layout. Open it with: rerun run.rrd.

    \b
    Examples:
      beliefscope record door --filter crossmodal-ekf --episode 9 --maps 5 -o run.rrd
      beliefscope record door --filter crossmodal-pf --maps 1 --map-size 41 -o every.rrd
      beliefscope record door --filter crossmodal-pf --faults image_frozen=20 -o frozen.rrd
    """
    from beliefscope.inspect.catalog import quick
    from beliefscope.inspect.likelihood import MapEngine, no_maps
    from beliefscope.recordings.write import write_recording

    if maps and (why := no_maps(checkpoint, made)):
        console.say(f"without maps: {why}")
        maps = 0
    layers = MapEngine(checkpoint, made).maps(range(0, len(made), maps), map_size) if maps else None
    found = quick(made, checkpoint) if diagnostics else {}
    with console.progress("Recording") as advance:
        write_recording(made, output, maps=layers, progress=advance, diagnostics=found)
    console.result(
        described(made, output) | {"maps": maps, "map_size": map_size, "diagnostics": list(found)},
        title(made, output),
        json,
    )

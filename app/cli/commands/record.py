"""``beliefscope record``"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output as console

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace


@opt.with_run_options
def record(
    checkpoint: Checkpoint,
    trace: Trace,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN.rrd", help="Output recording.")],
    maps: Annotated[
        int, typer.Option(parser=opt.integer(0), metavar="STRIDE", help="Likelihood maps every STRIDE steps; 0: none.")
    ] = 10,
    map_size: Annotated[
        int, typer.Option(parser=opt.integer(2, 1024), metavar="S", help="Cells per side of a map.")
    ] = 135,
    diagnostics: Annotated[bool, typer.Option(help="Include every applicable fast diagnostic, one tab each.")] = True,
    json: opt.Json = None,
) -> None:
    """Record a filter run over one episode as a Rerun recording.

    Contains images, particles or covariance ellipses, estimates with the true state, fusion weights, contact, errors,
    likelihood maps and diagnostics, and their layout. Open it with: rerun run.rrd

    \b
    Examples:
      beliefscope record door --filter crossmodal-ekf --episode 9 --maps 5 -o run.rrd
      beliefscope record door --filter crossmodal-pf --maps 1 --map-size 41 -o every.rrd
      beliefscope record door --filter crossmodal-pf --faults image_frozen=20 -o frozen.rrd
    """
    from beliefscope.inspect.catalog import quick
    from beliefscope.inspect.likelihood import MapEngine, no_maps
    from beliefscope.recordings.write import write_recording

    if maps and (reason := no_maps(checkpoint, trace)):
        console.note(f"no likelihood maps: {reason}")
        maps = 0
    layers = MapEngine(checkpoint, trace).maps(range(0, len(trace), maps), map_size) if maps else None
    results = quick(trace, checkpoint) if diagnostics else {}
    with console.progress("Recording") as advance:
        write_recording(trace, output, maps=layers, progress=advance, diagnostics=results)
    opt.print_trace(trace, output, json, maps=maps, map_size=map_size, diagnostics=list(results))

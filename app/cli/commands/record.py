from pathlib import Path

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput


def record(
    run: opt.Run,
    output: Path = opt.output_file("RUN.rrd", "Output recording.", ".rrd", default=...),
    maps: int = opt.option("STRIDE", "Likelihood maps every STRIDE steps; 0: none.", 10, parser=opt.integer(0)),
    map_size: int = opt.option("S", "Cells per side of a map.", 135, parser=opt.integer(2, 1024)),
    quantity: opt.Quantity | None = None,
    diagnostics: bool = opt.flag("Include every applicable fast diagnostic, one tab each.", default=True),
) -> console.Result:
    """Record a filter run over one episode as a Rerun recording.

    The recording has images, particles or covariance ellipses, estimates with the true state, fusion weights, contact,
    errors, likelihood maps, diagnostics, and a layout for them. Open it with: rerun run.rrd

    \b
    Examples:
      beliefscope record door --filter crossmodal-ekf --episode 9 --maps 5 -o run.rrd
      beliefscope record door --filter crossmodal-pf --maps 1 --map-size 41 -o every.rrd
      beliefscope record door --filter crossmodal-pf --faults image_frozen=20 -o frozen.rrd
    """
    from beliefscope.inspect.catalog import quick
    from beliefscope.inspect.maps.availability import no_maps
    from beliefscope.inspect.maps.map_engine import MapEngine
    from beliefscope.recordings.write import write_recording

    checkpoint, faults = run.open()
    trace = run.over(checkpoint, *run.read_episode(checkpoint.task), faults)
    if maps and (reason := no_maps(checkpoint, trace, quantity)):
        if quantity:
            raise BadInput(reason)
        console.note(f"recorded without maps: {reason}")
        maps = 0
    steps = range(0, len(trace), maps) if maps else range(0)
    layers = MapEngine(checkpoint, trace).maps(steps, map_size, quantity=quantity) if maps else None
    results = quick(trace, checkpoint) if diagnostics else {}
    with console.progress("Recording") as advance:
        write_recording(trace, output, maps=layers, progress=advance, diagnostics=results)
    return opt.trace_result(trace, output, maps=maps, map_size=map_size, diagnostics=list(results))

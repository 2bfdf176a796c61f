from __future__ import annotations

from pathlib import Path

from beliefscope.app.cli import console
from beliefscope.app.cli import options as opt


@opt.with_options(
    source=opt.argument("TRACE|RUN.rrd", "Trace file or recording."),
    output=opt.output_file("FILE", "Output file: .parquet, .mcap or .npz."),
    task=opt.TASK_OF_FILES,
)
def export(source: Path, output: Path, task: str = "") -> console.Result:
    """Export a trace to Parquet, MCAP or NumPy.

    Parquet has one row per step and one column per number, for pandas and similar tools. MCAP has one topic per array,
    and images and particles in Foxglove's schemas. npz has the arrays unchanged. Names: docs/recordings.md.

    \b
    Examples:
      beliefscope export run.trace -o run.parquet
      beliefscope export run.rrd -o run.mcap
    """
    from beliefscope.recordings.export import export_format, export_trace

    export_format(output)
    trace = opt.open_trace(source, task)
    export_trace(trace, output)
    return opt.trace_result(trace, output)

"""``beliefscope export``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import options as opt


def export(
    source: Annotated[Path, typer.Argument(metavar="TRACE|RUN.rrd", help="Trace file or recording.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="Output file: .parquet, .mcap or .npz.")
    ],
    json: opt.Json = None,
) -> None:
    """Export a trace to Parquet, MCAP or NumPy.

    Parquet has one row per step and one column per number, for pandas and similar tools. MCAP has one topic per array,
    and images and particles in Foxglove's schemas. npz has the arrays unchanged. Names: docs/recordings.md.

    \b
    Examples:
      beliefscope export run.trace -o run.parquet
      beliefscope export run.rrd -o run.mcap
    """
    from beliefscope.recordings.export import export_format, export_trace

    opt.check_output(output)
    export_format(output)
    trace = opt.open_trace(source)
    export_trace(trace, output)
    opt.print_trace(trace, output, json)

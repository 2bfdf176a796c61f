"""``beliefscope export``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import Json, check, described, title, trace_in


def export(
    source: Annotated[Path, typer.Argument(metavar="TRACE|RUN.rrd", help="File of beliefscope trace, or a recording.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="What to write: .parquet, .mcap or .npz.")
    ],
    json: Json = None,
) -> None:
    """Write a trace for other tools.

    Parquet has one row a step and a column for each number, for pandas and its like. MCAP has a topic for each array,
    pictures and particles as Foxglove shows them. npz has the arrays as they are. docs/recordings.md has the names.

    \b
    Examples:
      beliefscope export run.trace -o run.parquet
      beliefscope export run.rrd -o run.mcap
    """
    from beliefscope.recordings.export import export_format, export_trace

    check(output, json)
    export_format(output)
    found = trace_in(source)
    export_trace(found, output)
    console.result(described(found, output), title(found, output), json)

"""``beliefscope import``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import options as opt


def import_(
    recording: Annotated[Path, typer.Argument(metavar="RUN.rrd|RUN.live", help="Recording, or file of a live run.")],
    output: opt.TracePath,
    json: opt.Json = None,
) -> None:
    """Extract the trace from a recording.

    The arrays equal those of the recorded trace, including their types, so all diagnostics give the same results. Of
    a live run that is in progress or was killed, the complete steps are extracted.

    \b
    Examples:
      beliefscope import run.rrd -o run.trace
      beliefscope import workspace/live/run.live -o run.trace
    """
    from beliefscope.inspect.trace import save_trace

    opt.check_output(output)
    trace = opt.open_recording(recording)
    save_trace(trace, output)
    opt.print_trace(trace, output, json)

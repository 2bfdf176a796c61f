"""``beliefscope import``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import Json, check, described, recording_in, title


def restore(
    recording: Annotated[
        Path, typer.Argument(metavar="RUN.rrd|RUN.live", help="File of beliefscope record or live, or of the page.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="TRACE", help="Where to write the trace.")],
    json: Json = None,
) -> None:
    """Get the trace out of a recording.

    The very numbers of the trace that the recording was made from, in their own types, so that all that is computed
    from it is the same: beliefscope inspect says the same of both. Of a live run that goes on, or was killed: the steps
    that there are.

    \b
    Examples:
      beliefscope import run.rrd -o run.trace
      beliefscope import workspace/live/run.live -o run.trace
    """
    from beliefscope.inspect.trace import save_trace

    check(output, json)
    found = recording_in(recording)
    save_trace(found, output)
    console.result(described(found, output), title(found, output), json)


restore.__name__ = "import"  # which no function can be defined as

"""``beliefscope trace``"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import Json, described, of_one_run, title

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace


@of_one_run
def trace(
    checkpoint: Checkpoint,
    made: Trace,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="TRACE", help="Where to write the trace.")],
    json: Json = None,
) -> None:
    """Keep all a filter knew, step by step.

    Beliefs before and after each observation, what each modality alone believes, fusion weights as the network gave
    them and as they acted, particles and their ancestors. The estimates are bit-identical to those of a run that
    keeps nothing. In Python: beliefscope.inspect.trace.load_trace.

    \b
    Examples:
      beliefscope trace door --filter crossmodal-pf --episode 9 -o run.trace
      beliefscope trace door --filter crossmodal-pf --faults force_bias:x=5:from=20 -o biased.trace
    """
    from beliefscope.inspect.trace import save_trace

    save_trace(made, output)
    console.result(described(made, output), title(made, output), json)

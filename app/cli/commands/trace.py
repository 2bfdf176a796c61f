"""``beliefscope trace``"""

from __future__ import annotations

from typing import TYPE_CHECKING

from beliefscope.app.cli import options as opt

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace


@opt.with_run_options
def trace(checkpoint: Checkpoint, trace: Trace, output: opt.TracePath, json: opt.Json = None) -> None:
    """Save all internal quantities of a filter run.

    A trace contains, for every step, the beliefs before and after the observation, each modality's own update, fusion
    weights as output by the network and effective weights, particles and their ancestors. Estimates are bit-identical
    to those of a run without tracing. Read it in Python with beliefscope.inspect.trace.load_trace.

    \b
    Examples:
      beliefscope trace door --filter crossmodal-pf --episode 9 -o run.trace
      beliefscope trace door --filter crossmodal-pf --faults force_bias:x=5:from=20 -o biased.trace
    """
    from beliefscope.inspect.trace import save_trace

    save_trace(trace, output)
    opt.print_trace(trace, output, json)

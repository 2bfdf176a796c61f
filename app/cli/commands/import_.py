from __future__ import annotations

from pathlib import Path

from beliefscope.app.cli import console
from beliefscope.app.cli import options as opt


@opt.with_options(
    recording=opt.argument("RUN.rrd|RUN.live", "Recording, or file of a live run."),
    output=opt.TRACE,
    task=opt.TASK_OF_FILES,
)
def import_(recording: Path, output: Path, task: str = "") -> console.Result:
    """Extract the trace from a recording.

    The arrays equal those of the recorded trace, including their types, so all diagnostics give the same results. Of
    a live run that is in progress or was killed, the complete steps are extracted.

    \b
    Examples:
      beliefscope import run.rrd -o run.trace
      beliefscope import workspace/live/run.live -o run.trace
    """
    from beliefscope.inspect.trace import save_trace

    trace = opt.open_recording(recording, task)
    save_trace(trace, output)
    return opt.trace_result(trace, output)

"""Job that computes a diagnostic over one or more episodes."""

from collections.abc import Mapping
from typing import Any

from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import store_of_job
from beliefscope.app.runs.worker import Report
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.open_trace import of_one_task, with_distinct_indices

POLL_INTERVAL = 0.25  # s


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Compute the result's views; stored traces are reused."""
    entry = DIAGNOSTICS[arguments["diagnostic"]]
    selections = [Selection.from_json(values) for values in arguments["selections"]]
    count = len(selections)
    traces: list[Trace] = []
    with store_of_job(arguments) as store:
        for i, selection in enumerate(selections):
            traced = store.request(selection)
            while not traced.ready(POLL_INTERVAL):
                report(0.5 * (i + traced.progress) / count, f"running the filter over episode {selection.episode}")
            traces.append(traced.trace)
            report(0.5 * (i + 1) / count, f"{i + 1} of {count} episodes filtered")
        if len({selection.data for selection in selections}) > 1:  # live runs, each a data set of its own
            traces = with_distinct_indices(of_one_task(traces, [selection.data for selection in selections]))
        message = f"evaluating {count} episodes" if count > 1 else f"evaluating episode {selections[0].episode}"
        report(0.5, message)
        callback = {"progress": lambda share: report(0.5 + 0.5 * share, message)} if entry.takes_progress else {}
        result = entry(traces, traced.checkpoint, **arguments["options"], **callback)
        return {"trajectories": count, **result.views()}

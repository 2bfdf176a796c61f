"""Job that writes the report of a run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from beliefscope.app.protocol.permalinks import permalink
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import store_of_job
from beliefscope.app.runs.worker import Report
from beliefscope.filters.checkpoint import PRETRAINED
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.names import is_code
from beliefscope.inspect.maps.availability import missing_quantities
from beliefscope.recordings.report.command_lines import report_command, serve_command, trace_command
from beliefscope.recordings.report.pdf import browser


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Write the report's folder; a stored trace is reused. ``options``: see ``api.reports.ReportRequest``."""
    from beliefscope.recordings.report.compose import compose, write_report  # imports Rerun

    options = arguments["options"]
    events, slow, title, quantity = (options[name] for name in ("events", "slow", "title", "quantity"))
    with store_of_job(arguments) as store:
        selection = Selection.from_json(arguments["selection"])
        report(0.0, "running the filter")
        traced = store.request(selection)
        trace, task = traced.trace, traced.checkpoint.task
        settings = store.settings
        filter_, data = traced.checkpoint, settings.data.get(selection.data)
        path = "" if filter_.path is None or filter_.path.parent == PRETRAINED else str(filter_.path)
        if isinstance(filter_, ExternalFilter) and is_code(filter_.source):
            path = filter_.source
        map_option = [] if quantity == "likelihood" else ["--map", quantity]
        quantity = None if quantity in missing_quantities(traced.checkpoint, trace) else quantity
        serve = serve_command(filter(None, [path]), data, settings.seed)

        def link(index: int, step: int) -> str:
            faults = str(selection.faults)
            query = permalink(task, selection.filter, selection.data, selection.episode, step, faults)
            return arguments["url"] + query

        composed = compose(
            [trace],
            traced.checkpoint,
            title=title,
            steps=[(0, step) for step in events],
            slow=slow,
            link=link,
            links_note=f"Permalinks work while this command runs: {serve}.",
            commands=(
                trace_command(trace, "run.trace", path, data),
                report_command(["run.trace"], events, slow, title, *map_option),
            ),
            quantity=quantity,
            progress=lambda share: report(0.1 + 0.4 * share, "computing diagnostics"),
        )
        folder = Path(arguments["folder"])
        folder.parent.mkdir(parents=True, exist_ok=True)
        chromium = browser() if options["pdf"] else None
        document = write_report(composed, folder, chromium, lambda share: report(0.5 + 0.5 * share, "drawing figures"))
        return {"folder": str(folder), "files": document["files"]}

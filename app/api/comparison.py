"""Route of the comparison of two runs."""

from typing import Annotated

from fastapi import FastAPI, Query
from fastapi.responses import JSONResponse, Response

from beliefscope.app.api.models import ResultViews
from beliefscope.app.api.traces import IN_PROGRESS, RequestedRun, finished_run
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.inspect.compare.counterfactual import compare
from beliefscope.inspect.compare.two_runs import compare_runs


class Comparison(ResultViews):
    """Comparison of two runs. intervention: in words, or None."""

    names: tuple[str, str]
    intervention: str | None


def add_routes(app: FastAPI, store: TraceStore) -> None:
    @app.get("/api/compare/{task}/{filter}/{episode}", response_model=Comparison, responses=IN_PROGRESS)
    def comparison(selection: RequestedRun, against: Annotated[str, Query(min_length=1)]) -> Response:
        other = selection.comparison(against)
        store.request(other)  # starts it
        run, other_run = finished_run(store, selection), finished_run(store, other)
        names, intervention = _names(selection, other), other.intervention
        if intervention is None:
            views = compare_runs(run.trace, other_run.trace, names).views()
        else:
            views = compare(run.trace, other_run.trace, intervention).views()
        text = None if intervention is None else str(intervention)
        return JSONResponse({"names": names, "intervention": text, **views})


def _names(run: Selection, other: Selection) -> tuple[str, str]:
    """Names of the two runs that state their difference."""
    if other.intervention is not None:
        return "original", "with intervention"
    if other.only:
        return "all modalities", f"{other.only} standalone"
    fault_names = [str(selection.faults) or "as recorded" for selection in (run, other)]
    if run.filter == other.filter:
        return fault_names[0], fault_names[1]
    if run.faults == other.faults:
        return run.filter, other.filter
    return f"{run.filter}, {fault_names[0]}", f"{other.filter}, {fault_names[1]}"

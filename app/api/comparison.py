"""The run that is shown beside another one over HTTP (docs/api.md): another filter, other faults, or an edit."""

from __future__ import annotations

from concurrent.futures import TimeoutError as NotYet
from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import JSONResponse, Response

from beliefscope.app.api.traces import PATIENCE, Asked
from beliefscope.app.runs.trace_store import Library, Selection
from beliefscope.inspect.compare.counterfactual import compare
from beliefscope.inspect.compare.two_runs import compare_runs
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.trace import Trace


def routes(library: Library) -> APIRouter:
    """``/api/compare``."""
    router = APIRouter()

    @router.get("/api/compare/{task}/{filter}/{episode}")
    def comparison(asked: Asked, against: Annotated[str, Query(min_length=1)]) -> Response:
        other = asked.against(against)
        both = [library.traced(selection) for selection in (asked, other)]
        try:
            this, that = (traced.result(PATIENCE) for traced in both)
        except NotYet:
            return JSONResponse({"progress": sum(traced.progress for traced in both) / 2}, status_code=202)
        names = _names(asked, other)
        found = _compared(this, that, other, names)
        return JSONResponse({"names": names, "edit": None if other.edit is None else str(other.edit), **found.views()})

    return router


def _compared(this: Trace, that: Trace, other: Selection, names: tuple[str, str]) -> Diagnostic:
    return compare_runs(this, that, names) if other.edit is None else compare(this, that, other.edit)


def _names(asked: Selection, other: Selection) -> tuple[str, str]:
    """What tells the two runs apart, by the names under which the page shows them."""
    if other.edit is not None:
        return "original", "edited"
    fault_sets = [str(run.faults) or "as recorded" for run in (asked, other)]
    if asked.filter == other.filter:
        return fault_sets[0], fault_sets[1]
    if asked.faults == other.faults:
        return asked.filter, other.filter
    return f"{asked.filter}, {fault_sets[0]}", f"{other.filter}, {fault_sets[1]}"

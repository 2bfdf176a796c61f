"""Diagnostics over HTTP (docs/api.md): of one episode, or of all that are held out; slow ones as jobs."""

from __future__ import annotations

import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Mapping
from concurrent.futures import TimeoutError as NotYet
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, HTTPException, Request
from fastapi.responses import FileResponse, JSONResponse, Response

from beliefscope.app.api.traces import PATIENCE, Asked
from beliefscope.app.jobs.queue import Jobs, under_way
from beliefscope.app.jobs.worker import Report
from beliefscope.app.protocol.diagnostic_options import described, parse, says_how_far
from beliefscope.app.runs.trace_store import Library, Selection, Settings, Traced
from beliefscope.datasets.errors import one_of
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.base import Entry
from beliefscope.inspect.trace import Trace

RESULTS_IN_MEMORY = 64
HELD_OUT = "held-out"
NAMES_OF_A_TRACE = ("faults", "data", "episodes")
"""What a query names beside the diagnostic's own options."""


def _entry(name: str) -> Entry:
    if name not in DIAGNOSTICS:
        raise HTTPException(404, str(one_of("diagnostic", name, DIAGNOSTICS)))
    return DIAGNOSTICS[name]


def _options(name: str, request: Request) -> dict[str, Any]:
    return parse(_entry(name), {k: v for k, v in request.query_params.items() if k not in NAMES_OF_A_TRACE})


Named = Annotated[Entry, Depends(_entry)]
Options = Annotated[dict[str, Any], Depends(_options)]
Episodes = Literal["held-out"] | None


def routes(library: Library, jobs: Jobs) -> APIRouter:
    """Every route under ``/api/diagnostics``."""
    router = APIRouter()
    made = _Made()

    @router.get("/api/diagnostics")
    def list_entries() -> list[dict[str, Any]]:
        return [described(entry) for entry in DIAGNOSTICS.values()]

    @router.get("/api/diagnostics/{task}/{filter}/{episode}")
    def list_of_trace(asked: Asked) -> Response:
        traced = library.traced(asked)
        trace = _there(traced)
        if trace is None:
            return _not_yet(traced)
        refused = {name: entry.refusal(trace, traced.checkpoint) for name, entry in DIAGNOSTICS.items()}
        return JSONResponse([described(entry) | {"why_not": refused[name]} for name, entry in DIAGNOSTICS.items()])

    @router.get("/api/diagnostics/{name}/{task}/{filter}/{episode}")
    def views(entry: Named, asked: Asked, options: Options, episodes: Episodes = None) -> Response:
        traced = library.traced(asked)
        trace = _there(traced)
        if trace is None:
            return _not_yet(traced)
        _allow(entry, trace, traced)
        if not (entry.slow or episodes):
            return Response(made.views(entry, traced, trace, options), media_type="application/json")
        job = jobs.find("diagnostic", _key(library, entry, _selections(library, asked, episodes), options))
        if job is not None and job.state == "done" and (result := jobs.result(job.id)):
            return FileResponse(result, media_type="application/json")
        return under_way(job)

    @router.post("/api/diagnostics/{name}/{task}/{filter}/{episode}", status_code=202)
    def compute(entry: Named, asked: Asked, options: Options, episodes: Episodes = None) -> Response:
        traced = library.traced(asked)
        _allow(entry, traced.trace, traced)
        selections = _selections(library, asked, episodes)
        arguments = {
            "settings": library.settings.to_json(),
            "diagnostic": entry.name,
            "options": options,
            "selections": [selection.to_json() for selection in selections],
        }
        where = f"all {len(selections)} held-out episodes" if episodes else f"episode {asked.episode}"
        title = ", ".join(
            [f"{entry.title} of {asked.filter}", f"{asked.task} {where}", *filter(None, [str(asked.faults)])]
        )
        key = _key(library, entry, selections, options)
        return under_way(jobs.submit("diagnostic", title, arguments, key, _link(entry, asked, options, episodes)))

    return router


def work(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The job of a diagnostic: its views. What was traced before is read, not traced again."""
    entry = DIAGNOSTICS[arguments["diagnostic"]]
    selections = [Selection.of_json(shown) for shown in arguments["selections"]]
    library = Library(Settings.of_json(arguments["settings"]))
    traces: list[Trace] = []
    try:
        for i, of in enumerate(selections):
            traced = library.traced(of)
            while (trace := _there(traced)) is None:
                report(0.5 * (i + traced.progress) / len(selections), f"running the filter over episode {of.episode}")
            traces.append(trace)
            report(0.5 * (i + 1) / len(selections), f"{i + 1} of {len(selections)} episodes are filtered")
        one = f"episode {selections[0].episode}"
        measuring = f"measuring {len(traces)} episodes" if len(traces) > 1 else f"measuring {one}"
        report(0.5, measuring)
        more = {"progress": lambda share: report(0.5 + 0.5 * share, measuring)} if says_how_far(entry) else {}
        found = entry(traces, traced.checkpoint, **arguments["options"], **more)
        return {"trajectories": len(traces), **found.views()}
    finally:
        library.close()


class _Made:
    """The newest results of fast diagnostics, as JSON."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._results: OrderedDict[str, bytes] = OrderedDict()

    def views(self, entry: Entry, traced: Traced, trace: Trace, options: Mapping[str, Any]) -> bytes:
        """Computes them where they are not there, one at a time."""
        key = repr((entry.name, traced.key, sorted(options.items())))
        with self._lock:
            if key not in self._results:
                found = entry([trace], traced.checkpoint, **options)
                self._results[key] = json.dumps({"trajectories": 1, **found.views()}, allow_nan=False).encode()
            self._results.move_to_end(key)
            while len(self._results) > RESULTS_IN_MEMORY:
                self._results.popitem(last=False)
            return self._results[key]


def _there(traced: Traced) -> Trace | None:
    """The trace; None where it takes longer than a moment. Raises what computing it raised."""
    try:
        return traced.result(PATIENCE)
    except NotYet:
        return None


def _not_yet(traced: Traced) -> JSONResponse:
    return JSONResponse({"progress": traced.progress}, status_code=202)


def _allow(entry: Entry, trace: Trace, traced: Traced) -> None:
    why = entry.refusal(trace, traced.checkpoint)
    if why:
        raise HTTPException(409, why)


def _selections(library: Library, asked: Selection, episodes: Episodes) -> list[Selection]:
    return library.held_out(asked) if episodes == HELD_OUT else [asked]


def _key(library: Library, entry: Entry, selections: list[Selection], options: Mapping[str, Any]) -> str:
    """Of all that a result depends on. A trace of an index differs from the same episode's under another one."""
    traces = [(selection.episode, library.key(selection)) for selection in selections]
    return hashlib.sha256(repr((entry.name, traces, sorted(options.items()))).encode()).hexdigest()


def _link(entry: Entry, asked: Selection, options: Mapping[str, Any], episodes: Episodes) -> str:
    """The page's address with this open."""
    kept = {"task": asked.task, "filter": asked.filter, "data": asked.data, "episode": asked.episode}
    opened = {"faults": str(asked.faults), "diagnostic": entry.name, "options": urlencode(options), "over": episodes}
    return "?" + urlencode(kept | {"tab": "diagnostics"} | {name: text for name, text in opened.items() if text})

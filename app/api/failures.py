"""Where a filter fails, over HTTP (docs/api.md): a survey of a data set as a job, ranked by every score it has."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends
from fastapi.responses import FileResponse, JSONResponse, Response

from beliefscope.app.api.traces import PATIENCE
from beliefscope.app.jobs.queue import Jobs, under_way
from beliefscope.app.jobs.worker import Report
from beliefscope.app.protocol.permalinks import moment_link
from beliefscope.app.runs.live_runs import PREFIX
from beliefscope.app.runs.trace_store import Library, Selection, Settings
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.diagnostics.base import as_json
from beliefscope.inspect.failures.by_episode import by_episode
from beliefscope.inspect.failures.moments import Failures, failures_of, survey_of
from beliefscope.inspect.failures.step_scores import Survey, scores_of

Among = Literal["held-out", "all"]

LISTED = 500
"""Moments of one score that a result has, the worst ones; it counts them all."""


@dataclass(frozen=True)
class Wanted:
    """A survey: names of a task, a filter and a data set, which of its episodes, how the sensors are broken."""

    task: str
    filter: str
    data: str
    among: Among
    faults: Faults


def _wanted(task: str, filter: str, data: str = "", among: Among = "held-out", faults: str = "") -> Wanted:
    return Wanted(task, filter, data, among, Faults.parse(faults))


Asked = Annotated[Wanted, Depends(_wanted)]
"""What a path and its query name."""


def routes(library: Library, jobs: Jobs) -> APIRouter:
    """Every route under ``/api/failures``."""
    router = APIRouter()

    @router.get("/api/failures/{task}/{filter}")
    def found(asked: Asked) -> Response:
        if asked.data.startswith(PREFIX):
            return _of_live(library, asked)
        job = jobs.find("failures", _key(library, _arguments(library, asked)))
        if job is not None and job.state == "done" and (result := jobs.result(job.id)):
            return FileResponse(result, media_type="application/json")
        return under_way(job)

    @router.post("/api/failures/{task}/{filter}", status_code=202)
    def look(asked: Asked) -> Response:
        arguments = _arguments(library, asked)
        count, faults = len(arguments["episodes"]), arguments["faults"]
        where = f"all {count} episodes" if asked.among == "all" else f"{count} held-out episodes"
        title = ", ".join([f"Failures of {asked.filter}", f"{asked.task} {where}", *filter(None, [faults])])
        kept = {name: arguments[name] for name in ("task", "filter", "data", "among", "faults") if arguments[name]}
        link = "?" + urlencode(kept | {"tab": "failures"})
        return under_way(jobs.submit("failures", title, arguments, _key(library, arguments), link))

    return router


def work(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The job: runs the filter over the episodes, keeps none of the traces, and ranks the moments by each score."""
    episodes, faults = arguments["episodes"], Faults.parse(arguments["faults"])
    settings = Settings.of_json(arguments["settings"])
    library = Library(settings)

    def progress(share: float) -> None:
        at = min(int(share * len(episodes)), len(episodes) - 1)
        report(share, f"running the filter over episode {episodes[at]}, {at + 1} of {len(episodes)}")

    try:
        survey = survey_of(
            library.checkpoint(arguments["task"], arguments["filter"]),
            library.dataset(arguments["task"], arguments["data"])[1],
            episodes,
            faults=faults,
            seed=settings.seed,
            particles=settings.particles,
            progress=progress,
        )
    finally:
        library.close()
    return _named(arguments) | document(survey, arguments["filter"], arguments["data"])


def _of_live(library: Library, asked: Wanted) -> Response:
    """Of a live run, whose one episode is not run for it again. Raises BadInput while the run goes on."""
    run = library.live.ended(asked.data)
    of = Selection(asked.task, asked.filter, run.like.episode_index, asked.faults, asked.data)
    traced = library.traced(of)
    if not traced.ready(PATIENCE):
        return JSONResponse({"progress": traced.progress}, status_code=202)
    found = document(Survey.of([traced.trace]), asked.filter, asked.data)
    return JSONResponse(_named(vars(asked) | {"faults": str(asked.faults)}) | found)


def _named(asked: Mapping[str, Any]) -> dict[str, Any]:
    return {name: asked[name] for name in ("filter", "data", "faults", "among")}


def document(survey: Survey, filter_: str, data: str) -> dict[str, Any]:
    """A survey as JSON: its failures by each score of the task, and its episodes; SI units.

    Args:
        filter_, data: names as the page shows them, for the links.
    """
    scores: list[dict[str, Any]] = []
    for name, score in scores_of(survey.task).items():
        known = {"name": name, "title": score.title, "unit": score.unit, "why_not": survey.refused.get(name)}
        ranked = {} if known["why_not"] else _ranked(failures_of(survey, name), survey, filter_, data)
        scores.append(known | ranked)
    shown: dict[str, Any] = as_json(
        {
            "task": survey.task.name,
            "steps": len(survey.step),
            "layers": survey.layers,
            "particles": survey.particles,
            "scores": scores,
            "episodes": by_episode(survey),
        }
    )
    return shown


def _ranked(found: Failures, survey: Survey, filter_: str, data: str) -> dict[str, Any]:
    telling = {group.name for group in found.telling}
    counts: dict[int, int] = {}
    for moment in found.moments:
        counts[moment.episode] = counts.get(moment.episode, 0) + 1
    moments = [
        {
            "episode": m.episode,
            "step": m.step,
            "first": m.first,
            "last": m.last,
            "value": m.score,
            "group": m.group,
            "also": m.also,
            "error": m.error,
            "nees": m.nees[-1],
            "ess": m.ess,
            "acting": m.acting,
            "link": moment_link(survey.task, filter_, data, m.episode, m.step, survey.faults, found.by),
        }
        for m in found.worst(LISTED)
    ]
    groups = [asdict(group) | {"telling": group.name in telling} for group in found.groups]
    return {
        "verdict": found.verdict,
        "threshold": found.threshold,
        "total": len(found.moments),
        "counts": counts,
        "groups": groups,
        "moments": moments,
    }


def _arguments(library: Library, asked: Wanted) -> dict[str, Any]:
    """Of the job. Raises BadInput for what does not exist."""
    name, data = library.dataset(asked.task, asked.data)
    asked.faults.check(library.checkpoint(asked.task, asked.filter).task)
    return {
        "settings": library.settings.to_json(),
        "task": asked.task,
        "filter": asked.filter,
        "data": name,
        "among": asked.among,
        "faults": str(asked.faults),
        "episodes": data.held_out() if asked.among == "held-out" else list(range(len(data))),
    }


def _key(library: Library, arguments: Mapping[str, Any]) -> str:
    """Of all that a result depends on; names are in its links."""
    task, filter_, data = (arguments[name] for name in ("task", "filter", "data"))
    named = tuple(arguments[name] for name in ("task", "filter", "data", "among", "faults", "episodes"))
    hashes = (library.checkpoint(task, filter_).hash, library.data_hash(task, data))
    return hashlib.sha256(repr((named, hashes, library.settings.seed, library.settings.particles)).encode()).hexdigest()

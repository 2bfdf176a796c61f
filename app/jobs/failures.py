"""Job that runs a filter over a data set and ranks its failure events by every score."""

from collections.abc import Mapping
from contextlib import closing
from typing import Any

from beliefscope.app.protocol.permalinks import permalink
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.worker import Report
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.failures.events import Event
from beliefscope.inspect.failures.step_scores import Survey
from beliefscope.inspect.failures.survey import survey_of
from beliefscope.inspect.failures.survey_json import survey_document


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Compute the failure document; no traces are stored."""
    episodes = arguments["episodes"]

    def progress(share: float) -> None:
        at = min(int(share * len(episodes)), len(episodes) - 1)
        report(share, f"running the filter over episode {episodes[at]}, {at + 1} of {len(episodes)}")

    with closing(TraceStore(Settings.from_json(arguments["settings"]))) as store:
        survey = survey_of(
            store.checkpoint(arguments["task"], arguments["filter"]),
            store.dataset(arguments["task"], arguments["data"])[1],
            episodes,
            faults=Faults.parse(arguments["faults"]),
            seed=store.settings.seed,
            particles=store.settings.particles,
            progress=progress,
        )
    return failure_document(survey, arguments)


def failure_document(survey: Survey, selection: Mapping[str, Any]) -> dict[str, Any]:
    """The survey's document with permalinks. selection: ``filter``, ``data``, ``faults`` and ``among``, as text."""
    filter_, data = selection["filter"], selection["data"]

    def link(event: Event, by: str) -> str:
        return permalink(survey.task, filter_, data, event.episode, event.step, survey.faults, by)

    return {name: selection[name] for name in ("filter", "data", "faults", "among")} | survey_document(survey, link)

"""Job that runs a filter over a data set and ranks its failure events by every score."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from beliefscope.app.jobs.worker import Report
from beliefscope.app.protocol.permalinks import permalink
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.failures.by_episode import by_episode
from beliefscope.inspect.failures.events import Failures, failures_of, survey_of
from beliefscope.inspect.failures.step_scores import Survey, scores_of

MAX_EVENTS = 500
"""Events listed per score, worst first; the totals include all."""


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Compute the failure document; no traces are stored."""
    episodes = arguments["episodes"]
    settings = Settings.from_json(arguments["settings"])
    store = TraceStore(settings)

    def progress(share: float) -> None:
        at = min(int(share * len(episodes)), len(episodes) - 1)
        report(share, f"running the filter over episode {episodes[at]}, {at + 1} of {len(episodes)}")

    try:
        survey = survey_of(
            store.checkpoint(arguments["task"], arguments["filter"]),
            store.dataset(arguments["task"], arguments["data"])[1],
            episodes,
            faults=Faults.parse(arguments["faults"]),
            seed=settings.seed,
            particles=settings.particles,
            progress=progress,
        )
    finally:
        store.close()
    return failure_document(survey, arguments)


def failure_document(survey: Survey, selection: Mapping[str, Any]) -> dict[str, Any]:
    """A survey as JSON: its failures by each score of the task, and its episodes; SI units.

    Args:
        selection: ``filter`` and ``data`` (names on the page, for the permalinks), ``faults`` as text, ``among``.
    """
    scores: list[dict[str, Any]] = []
    for name, score in scores_of(survey.task).items():
        info = {"name": name, "title": score.title, "unit": score.unit, "why_not": survey.refused.get(name)}
        ranking = {} if info["why_not"] else _ranking(failures_of(survey, name), survey, selection)
        scores.append(info | ranking)
    document: dict[str, Any] = as_json(
        {
            **{name: selection[name] for name in ("filter", "data", "faults", "among")},
            "task": survey.task.name,
            "steps": len(survey.step),
            "layers": survey.layers,
            "particles": survey.particles,
            "scores": scores,
            "episodes": by_episode(survey),
        }
    )
    return document


def _ranking(failures: Failures, survey: Survey, selection: Mapping[str, Any]) -> dict[str, Any]:
    over_represented = {phase.name for phase in failures.over_represented}
    filter_, data = selection["filter"], selection["data"]
    events = [
        {
            "episode": event.episode,
            "step": event.step,
            "first": event.first,
            "last": event.last,
            "value": event.score,
            "phase": event.phase,
            "other_phases": event.other_phases,
            "error": event.error,
            "nees": event.nees[-1],
            "ess": event.ess,
            "effective_weights": event.effective_weights,
            "link": permalink(survey.task, filter_, data, event.episode, event.step, survey.faults, failures.by),
        }
        for event in failures.worst(MAX_EVENTS)
    ]
    phases = [asdict(phase) | {"over_represented": phase.name in over_represented} for phase in failures.phases]
    return {
        "verdict": failures.verdict,
        "threshold": failures.threshold,
        "total": len(failures.events),
        "counts": Counter(event.episode for event in failures.events),
        "phases": phases,
        "events": events,
    }

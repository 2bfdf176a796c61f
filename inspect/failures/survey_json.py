"""A survey of failures as a JSON document."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.failures.by_episode import by_episode
from beliefscope.inspect.failures.events import Event, Failures, failures_of
from beliefscope.inspect.failures.step_scores import Survey, scores_of

MAX_EVENTS = 500
"""Events listed per score, worst first; the totals include all."""

EVENT_FIELDS = (
    *("episode", "step", "first", "last", "time", "first_time", "last_time", "phase", "other_phases"),
    *("error", "ess", "effective_weights"),
)
"""Fields of an event that are listed as they are."""


def survey_document(survey: Survey, link: Callable[[Event, str], str]) -> dict[str, Any]:
    """A survey as JSON: its failures by each score of the task, and its episodes; SI units.

    Args:
        link: (event, score) -> permalink.
    """
    scores: list[dict[str, Any]] = []
    for name, score in scores_of(survey.task).items():
        info = {
            "name": name,
            "title": score.title,
            "unit": score.unit,
            "display_unit": score.display[0],
            "scale": score.display[1],
        }
        info |= {"why_not": survey.refused.get(name)}
        scores.append(info | ({} if info["why_not"] else _ranking(failures_of(survey, name), link)))
    document: dict[str, Any] = as_json(
        {
            "task": survey.task.name,
            "steps": len(survey.step),
            "layers": survey.layers,
            "particles": survey.particles,
            "scores": scores,
            "episodes": by_episode(survey),
        }
    )
    return document


def _ranking(failures: Failures, link: Callable[[Event, str], str]) -> dict[str, Any]:
    over_represented = {phase.name for phase in failures.over_represented}
    events = [
        {name: getattr(event, name) for name in EVENT_FIELDS}
        | {"value": event.score, "nees": event.nees[-1], "link": link(event, failures.by)}
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

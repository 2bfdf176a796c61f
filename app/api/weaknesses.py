"""Weaknesses of a filter that fine-tuning can address: from the diagnosis of a run, failure events and its defaults."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

from beliefscope.app.api.diagnosis import available_diagnosis
from beliefscope.app.api.failures import found_failures
from beliefscope.app.api.models.catalog import Reply
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.finetuning.choices import SliceInfo
from beliefscope.filters.finetuning.defaults import default_settings, reason
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.filters.finetuning.success import Criterion
from beliefscope.inspect.diagnosis.training import training_for, training_on

PROBABLE = 0.2
"""Smallest probability of a cause that is offered."""

PHASE_SLICES = {
    "contact made": Slice("contact", contact=True),
    "contact lost": Slice("contact", contact=True),
    "steady contact": Slice("contact", contact=True),
    "blackout": Slice("blackout 0.8", Faults.parse("blackout=0.8")),
    "free motion": Slice("free motion", contact=False),
}
"""Phase of failure events -> slice of the steps to learn from."""


class Weakness(Reply):
    """A weakness and the settings of a fine-tuning that addresses it.

    source: of the weakness. title: in words. evidence: its numbers. episode, step: moment that shows it, or None.
    slices: those of the settings.
    """

    source: Literal["diagnosis", "failures", "default"]
    title: str
    evidence: str
    episode: int | None
    step: int | None
    settings: dict[str, Any]
    slices: list[SliceInfo]


def weaknesses(store: TraceStore, jobs: Jobs, selection: Selection) -> list[Weakness]:
    """The weaknesses, diagnosed ones first. Raises InProgress while the run is computed."""
    checkpoint = store.checkpoint(selection.task, selection.filter)
    result = [*_diagnosed(store, jobs, selection, checkpoint), *_failing(store, jobs, selection, checkpoint)]
    settings = default_settings(checkpoint.filter)
    if why := reason(checkpoint.filter):
        name = settings.mix[0][0].name
        settings = replace(settings, success=Criterion(name))
        title = f"Sensor fault \u201c{name}\u201d, which the training data lack"
        result.append(
            Weakness(source="default", title=title, evidence=why, episode=None, step=None, **_training(settings))
        )
    return result


def _diagnosed(store: TraceStore, jobs: Jobs, selection: Selection, checkpoint: Checkpoint) -> Iterator[Weakness]:
    try:
        diagnosis = available_diagnosis(store, jobs, selection)
    except BadInput:  # no healthy profile
        return
    for cause in diagnosis["causes"]:
        settings = training_for(cause["cause"], checkpoint.filter, selection.faults)
        if cause["probability"] < PROBABLE or settings is None:
            continue
        evidence = next(iter(cause["evidence"]), None) or {"text": "", "episode": None, "step": None}
        text = f"Probability {cause['probability']:.2f}: {evidence['text']}"
        if (recovered := cause["recovered"]) and recovered["error"] is not None:
            text += f"; undoing it recovers {100 * recovered['error']:.0f} % of the error"
        title = diagnosis["headline"] if cause is diagnosis["causes"][0] else cause["cause"]
        episode = selection.episode if evidence["episode"] is None else evidence["episode"]
        moment = {"episode": episode, "step": evidence["step"]}
        yield Weakness(source="diagnosis", title=title, evidence=f"{text}.", **moment, **_training(settings))


def _failing(store: TraceStore, jobs: Jobs, selection: Selection, checkpoint: Checkpoint) -> Iterator[Weakness]:
    """Phases in which errors are over-represented, if the failures have been searched."""
    path = found_failures(store, jobs, selection)
    if path is None:
        return
    score = next(score for score in json.loads(path.read_bytes())["scores"] if score["name"] == "error")
    for phase in score.get("phases", ()):
        slice_ = PHASE_SLICES.get(phase["name"])
        settings = training_on(slice_, checkpoint.filter) if slice_ else None
        event = next((event for event in score["events"] if event["phase"] == phase["name"]), None)
        if not phase["over_represented"] or settings is None or event is None:
            continue
        evidence = (
            f"{100 * phase['share']:.0f} % of the steps and {100 * phase['event_share']:.0f} % of {score['total']} "
            f"events, {phase['lift']:.1f} times as many as expected (p = {phase['p_value']:.2g})."
        )
        title = f"Large errors in phase \u201c{phase['name']}\u201d"
        moment = {"episode": event["episode"], "step": event["step"]}
        yield Weakness(source="failures", title=title, evidence=evidence, **moment, **_training(settings))


def _training(settings: FineTune) -> dict[str, Any]:
    return {"settings": settings.to_json(), "slices": [SliceInfo.of(slice_) for slice_, _ in settings.mix]}

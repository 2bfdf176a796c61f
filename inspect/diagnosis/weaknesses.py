"""Weaknesses of a filter that fine-tuning can address: probable causes, faults, phases with failures, defaults."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.task import Task
from beliefscope.datasets.text import percent
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.defaults import default_settings, reason
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import Slice, fault_slice
from beliefscope.filters.finetuning.success import ERROR, Criterion, measures
from beliefscope.inspect.diagnosis.cause import probability_text, removes_error
from beliefscope.inspect.diagnosis.finetune_settings import training_for, training_on

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


@dataclass(frozen=True)
class Weakness:
    """A weakness and the settings of a fine-tuning run that addresses it.

    source: of the weakness. title: in words. evidence: its numbers. episode, step: where it shows, or None.
    """

    source: Literal["diagnosis", "faults", "failures", "default"]
    title: str
    evidence: str
    episode: int | None
    step: int | None
    settings: FineTune


def diagnosed(diagnosis: Mapping[str, Any], filter_: Filter, faults: Faults, episode: int) -> Iterator[Weakness]:
    """Probable causes of a diagnosis, as JSON values, of a run over an episode with these faults."""
    for cause in diagnosis["causes"]:
        settings = training_for(cause["cause"], filter_, faults)
        if cause["probability"] < PROBABLE or settings is None:
            continue
        evidence = next(iter(cause["evidence"]), None) or {"text": "", "episode": None, "step": None}
        text = f"Probability {probability_text(cause['probability'])}: {evidence['text']}"
        recovered = cause["recovered"]
        if recovered and recovered["error"] is not None and removes_error(recovered["error"]):
            text += f"; undoing it removes {percent(recovered['error'])} of the {recovered['measure']} error"
            settings = _measured_by(settings, recovered["measure"], filter_.task)
        title = diagnosis["headline"] if cause is diagnosis["causes"][0] else cause["title"]
        at = episode if evidence["episode"] is None else evidence["episode"]
        yield Weakness("diagnosis", title, f"{text}.", at, evidence["step"], settings)


def _measured_by(settings: FineTune, error: str, task: Task) -> FineTune:
    """Settings whose criterion, if it is about an error, is about that which the cause increases."""
    name = next((name for name, title in measures(task).items() if title == error), ERROR)
    if settings.success is None or settings.success.measure != ERROR:
        return settings
    return replace(settings, success=replace(settings.success, measure=name))


def injected(faults: Faults, filter_: Filter, episode: int) -> Iterator[Weakness]:
    """Faults that were injected into a run over an episode, if the filter can learn to expect them."""
    settings = training_on(fault_slice(faults), filter_) if faults else None
    if settings is not None:
        title = f"Injected faults \u201c{settings.mix[0][0].name}\u201d"
        yield Weakness("faults", title, "Faults of the displayed run.", episode, None, settings)


def failing(scores: Sequence[Mapping[str, Any]], filter_: Filter) -> Iterator[Weakness]:
    """Phases in which large errors are over-represented. scores: of a failure document."""
    score = next((score for score in scores if score["name"] == "error"), {})
    for phase in score.get("phases", ()):
        slice_ = PHASE_SLICES.get(phase["name"])
        settings = training_on(slice_, filter_) if slice_ else None
        event = next((event for event in score["events"] if event["phase"] == phase["name"]), None)
        if not phase["over_represented"] or settings is None or event is None:
            continue
        evidence = (
            f"{percent(phase['share'])} of the steps and {percent(phase['event_share'])} of {score['total']} "
            f"events, {phase['lift']:.1f} times as many as expected (p = {phase['p_value']:.2g})."
        )
        title = f"Large errors in phase \u201c{phase['name']}\u201d"
        yield Weakness("failures", title, evidence, event["episode"], event["step"], settings)


def untrained(checkpoint: Checkpoint) -> Iterator[Weakness]:
    """The sensor fault that the training data of a filter lack, if its default fine-tuning addresses one."""
    settings = default_settings(checkpoint.filter)
    base = checkpoint.record.get("base")
    trained_faults = [slice_.faults for slice_, _ in FineTune.from_json(base["settings"]).mix] if base else []
    if (why := reason(checkpoint.filter)) and settings.mix[0][0].faults not in trained_faults:
        name = settings.mix[0][0].name
        title = f"Sensor fault \u201c{name}\u201d, which the training data lack"
        yield Weakness("default", title, why, None, None, replace(settings, success=Criterion(name)))

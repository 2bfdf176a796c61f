"""Weaknesses of a filter that fine-tuning can address, with settings."""

import json
from typing import Any

from beliefscope.app.api.diagnosis import available_diagnosis
from beliefscope.app.api.failures import found_failures
from beliefscope.app.api.models import Reply, fields_of
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.finetuning.choices import SliceInfo
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.inspect.diagnosis import weaknesses


@fields_of(weaknesses.Weakness, "source", "title", "evidence", "episode", "step")
class Weakness(Reply):
    """A weakness and the settings of a fine-tuning run that addresses it. slices: those of the settings."""

    settings: dict[str, Any]
    slices: list[SliceInfo]


def weaknesses_of(store: TraceStore, jobs: Jobs, selection: Selection) -> list[Weakness]:
    """The weaknesses, diagnosed ones first; none of an external filter.

    Raises InProgress while the run is computed.
    """
    checkpoint = store.checkpoint(selection.task, selection.filter)
    if isinstance(checkpoint, ExternalFilter):  # FineTuneOffer.why_not
        return []
    try:
        diagnosis = available_diagnosis(store, jobs, selection)
    except BadInput:  # no healthy profile
        diagnosis = {"causes": []}
    path = found_failures(store, jobs, selection)
    scores = [] if path is None else json.loads(path.read_bytes())["scores"]
    filter_, faults, episode = checkpoint.filter, selection.faults, selection.episode
    entries = [
        *weaknesses.diagnosed(diagnosis, filter_, faults, episode),
        *weaknesses.failing(scores, filter_),
        *weaknesses.untrained(checkpoint),
    ]
    if not any(weakness.source == "diagnosis" for weakness in entries):
        entries = [*weaknesses.injected(faults, filter_, episode), *entries]
    return [Weakness(**vars(weakness) | _training(weakness.settings)) for weakness in entries]


def _training(settings: FineTune) -> dict[str, Any]:
    return {"settings": settings.to_json(), "slices": [SliceInfo.from_slice(slice_) for slice_, _ in settings.mix]}

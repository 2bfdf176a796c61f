"""All statistics of an episode that a healthy profile has: of its diagnostics, sensors and modules."""

from __future__ import annotations

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnosis.model_checks import model_statistics
from beliefscope.inspect.trace import Trace


def episode_statistics(trace: Trace, checkpoint: Checkpoint) -> dict[str, float]:
    """``KIND/SUBJECT/PHASE`` -> value, of all diagnostics that apply to the trace and of the modules."""
    values: dict[str, float] = {}
    for entry in DIAGNOSTICS.values():
        if entry.statistics is not None and entry.refusal(trace, None) is None:
            values |= entry.statistics(trace)
    return values | model_statistics(trace, checkpoint)

"""The largest error of the diagnosed runs, with the standard deviations that it has and the sources that cause it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics import error_sources
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

MAX_SIGMAS = 2
"""Largest deviation of one component in standard deviations that is consistent."""


MAX_STEPS = 1000
"""Largest number of steps of a run whose sources are computed with every diagnosis, and whenever it is displayed."""


@dataclass(frozen=True)
class LargestError:
    """The largest main error of several runs.

    Attributes:
        episode, step: where it is.
        size: the error, and its largest deviation in standard deviations.
        sources: the parts of the error by source; empty where they cannot be computed.
        overconfident: whether the deviation is more than twice as large as a consistent one.
    """

    episode: int
    step: int
    size: str
    sources: str
    overconfident: bool

    @property
    def text(self) -> str:
        return f"{self.size} ({self.sources})" if self.sources else self.size

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def largest_error(checkpoint: Checkpoint, traces: Sequence[Trace]) -> LargestError | None:
    """The largest main error of the counted steps, after the warm-up; None without a known true state there."""
    counted = (np.where(measures.counted(t), measures.main_error(t)[:, -1], np.nan) for t in traces)
    errors = [np.nan_to_num(error, nan=-1.0, posinf=-1.0) for error in counted]
    index = int(np.argmax([error.max(initial=-1.0) for error in errors]))
    trace, size = traces[index], errors[index].max(initial=-1.0)
    if size < 0.0:
        return None
    step, main = int(errors[index].argmax()), trace.task.main_error
    text = f"{main.name} error {main.text(size)}"
    components = trace.task.components
    sigmas, component = _largest_deviation(trace, step)
    if math.isfinite(sigmas):
        text += f", {sigmas:.1f} standard deviations in {components[component].label}"
    sources = ""
    if len(trace) <= MAX_STEPS and error_sources.ENTRY.refusal(trace, checkpoint) is None:
        parts = error_sources.along_error(checkpoint, trace)[step]
        sources = error_sources.parts_text(trace.task, error_sources.names_of(trace), parts)
    limit = 2.0 * math.sqrt(MAX_SIGMAS**2 + 2.0 * math.log(len(components)))  # the largest of several deviations
    return LargestError(trace.episode_index, step, text, sources, limit < sigmas < math.inf)


def _largest_deviation(trace: Trace, step: int) -> tuple[float, int]:
    """Largest error of a component in predicted standard deviations, and its index; NaN without a covariance."""
    variance = np.diagonal(trace.estimate_covariance[step]).astype(np.float64)
    error = np.abs(measures.errors(trace)[step, -1])
    known = np.isfinite(error) & (variance > 0.0)
    if not known.any():
        return math.nan, 0
    ratio = np.where(known, error / np.sqrt(np.where(known, variance, 1.0)), 0.0)
    return float(ratio.max()), int(ratio.argmax())

"""Error summary of each episode of a survey."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beliefscope.inspect.failures.step_scores import Survey
from beliefscope.inspect.statistics.measures import Array, Mask

POINTS = 96
"""Maximum length of the error series of an episode."""


@dataclass(frozen=True)
class EpisodeErrors:
    """Fused position error over one episode, m.

    Attributes:
        index: index in the data set.
        steps: T.
        rmse: over all steps but those of the task's warm-up.
        worst, worst_step: maximum over all steps; NaN and None without known errors.
        worst_time: s from the first step to ``worst_step``; None without timestamps.
        error: (P,) maximum in each of P equal parts of the episode.
        contact: (P,) whether there is contact in each part.
    """

    index: int
    steps: int
    rmse: float
    worst: float
    worst_step: int | None
    worst_time: float | None
    error: Array
    contact: Mask


def by_episode(survey: Survey) -> list[EpisodeErrors]:
    """Summarise a survey by episode, ordered by index."""
    firsts = np.flatnonzero(np.diff(survey.episode, prepend=-1))
    parts = zip(firsts, np.append(firsts[1:], len(survey.episode)), strict=True)
    return [_errors(survey, slice(first, end)) for first, end in parts]


def _errors(survey: Survey, part: slice) -> EpisodeErrors:
    error, contact = (
        survey.error[part, -1],
        survey.phases.get("steady contact", np.zeros(len(survey.error), bool))[part],
    )
    steps = len(error)
    counted = error[min(int(survey.phases["start"][part].sum()), steps - 1) :]
    has_errors = np.isfinite(error).any()
    worst_step = int(np.nanargmax(error)) if has_errors else None
    starts = np.linspace(0, steps, min(steps, POINTS), endpoint=False).astype(int)
    return EpisodeErrors(
        index=int(survey.episode[part.start]),
        steps=steps,
        rmse=float(np.sqrt(np.mean(counted**2))),
        worst=float(np.nanmax(error)) if has_errors else np.nan,
        worst_step=worst_step,
        worst_time=None if worst_step is None else survey.time_of(part.start + worst_step),
        error=np.fmax.reduceat(error, starts),
        contact=np.logical_or.reduceat(contact, starts),
    )

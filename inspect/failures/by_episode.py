"""A survey by episode: how far off each was, and its error over time in a few numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beliefscope.filters.evaluate import LEFT_OUT
from beliefscope.inspect.failures.step_scores import Survey
from beliefscope.inspect.statistics.measures import Array, Mask

POINTS = 96
"""At most so many numbers say how the error of an episode went."""


@dataclass(frozen=True)
class EpisodeErrors:
    """The fused position's error over one episode; m.

    Attributes:
        index: in the data set. steps: T.
        rmse: over the steps that ``evaluate`` counts, from ``LEFT_OUT`` on.
        worst, worst_step: over all steps; NaN and None where no error is known.
        error: (P,) the largest of each of P even parts of the episode.
        contact: (P,) whether there is any in each part.
    """

    index: int
    steps: int
    rmse: float
    worst: float
    worst_step: int | None
    error: Array
    contact: Mask


def by_episode(survey: Survey) -> list[EpisodeErrors]:
    """One for each episode, in the order of their indices."""
    firsts = np.flatnonzero(np.diff(survey.episode, prepend=-1))
    parts = zip(firsts, np.append(firsts[1:], len(survey.episode)), strict=True)
    return [_errors(survey, slice(first, end)) for first, end in parts]


def _errors(survey: Survey, of: slice) -> EpisodeErrors:
    error, contact = survey.error[of, -1], survey.happening["steady contact"][of]
    steps = len(error)
    counted = error[min(LEFT_OUT, steps - 1) :]
    known = np.isfinite(error).any()
    starts = np.linspace(0, steps, min(steps, POINTS), endpoint=False).astype(int)
    return EpisodeErrors(
        index=int(survey.episode[of.start]),
        steps=steps,
        rmse=float(np.sqrt(np.mean(counted**2))),
        worst=float(np.nanmax(error)) if known else np.nan,
        worst_step=int(np.nanargmax(error)) if known else None,
        error=np.fmax.reduceat(error, starts),
        contact=np.logical_or.reduceat(contact, starts),
    )

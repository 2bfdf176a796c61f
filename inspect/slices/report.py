"""Data slices in which a filter is worse than elsewhere, in words."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.task import with_unit
from beliefscope.datasets.text import capitalised, percent, plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.views import Array, Table, as_json
from beliefscope.inspect.failures.step_scores import EpisodeScores, Survey
from beliefscope.inspect.failures.survey import ScoredRuns, check_applies, fields_of_runs, find_score
from beliefscope.inspect.slices.covariates import EpisodeCovariates, join_covariates
from beliefscope.inspect.slices.search import ALPHA, Candidate, Condition, Index, find_candidates
from beliefscope.inspect.statistics.intervals import jackknife
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import Episodes, trace_all

MIN_SEARCHED = 8
"""Smallest number of episodes in which a search without a request by the user is worthwhile."""

MAX_STEPS = 200_000
"""Largest number of steps in such a search; limits memory."""


@dataclass(frozen=True)
class ErrorSlice:
    """A data slice with a larger score than the other steps.

    Attributes:
        conditions: one, or two that both hold.
        inside, outside: mean score of its steps, and of all others; SI units.
        ratio, low, high: inside / outside with its 95 % interval over episodes; NaN below five episodes.
        episodes: indices in the data set of the episodes with steps in the slice.
        worst: episode and step of its largest score, in an episode that is not the ``worst`` of a slice above, if any.
        steps, share: number of its steps, and their share of all.
        p_value: of the search, see ``inspect/slices/search.py``.
    """

    conditions: tuple[Condition, ...]
    inside: float
    outside: float
    ratio: float
    low: float
    high: float
    episodes: tuple[int, ...]
    worst: tuple[int, int]
    steps: int
    share: float
    p_value: float

    @property
    def where(self) -> str:
        """``panel friction > 2.1``, or two conditions joined by ``and``."""
        return " and ".join(map(str, self.conditions))


@dataclass(frozen=True)
class ErrorSlices(ScoredRuns):
    """The slices of a data set in which a score is larger.

    Attributes:
        alpha: probability of any slice if no covariate is related to the score.
        episodes, steps: numbers of episodes, and of steps with a score.
        covariates: names of the covariates that were searched.
        slices: in the order of their discovery.
    """

    alpha: float
    episodes: int
    steps: int
    covariates: tuple[str, ...]
    slices: tuple[ErrorSlice, ...]

    @property
    def verdict(self) -> str:
        """One sentence for each slice."""
        return " ".join([self.summary, *map(self.sentence, self.slices)])

    @property
    def summary(self) -> str:
        """``3 slices with a larger position error in 60 episodes, 12000 steps and 31 covariates.``"""
        sizes = (self.episodes, "episode"), (self.steps, "step"), (len(self.covariates), "covariate")
        episodes, steps, covariates = (plural(count, noun) for count, noun in sizes)
        slices = plural(len(self.slices), "slice") if self.slices else "No slice"
        return f"{slices} with a larger {self.title} in {episodes}, {steps} and {covariates}."

    def sentence(self, slice_: ErrorSlice) -> str:
        """``Position error is 2.3 times as large (1.8 to 2.9) where friction > 2.1: 14 of 60 episodes, ...``"""
        interval = f" ({slice_.low:.2g} to {slice_.high:.2g})" if np.isfinite(slice_.low) else ""
        size = f"{len(slice_.episodes)} of {self.episodes} episodes, {percent(slice_.share)} of steps"
        title = capitalised(self.title)
        return f"{title} is {slice_.ratio:.2g} times as large{interval} where {slice_.where}: {size}."

    def to_dict(self) -> dict[str, Any]:
        sentences = [{"where": s.where, "sentence": self.sentence(s)} for s in self.slices]
        slices = [as_json(s) | words for s, words in zip(self.slices, sentences, strict=True)]
        return super().to_dict() | {"slices": slices}

    def tables(self) -> list[Table]:
        """One row per slice; scores in display units."""
        unit, factor = self.conversion
        means = (with_unit(name, unit) for name in ("inside", "outside"))
        columns = ("slice", "ratio", "from", "to", *means, "episodes", "steps", "steps (%)", "p-value")
        rows = [
            (
                *(s.where, s.ratio, s.low, s.high, factor * s.inside, factor * s.outside),
                *(len(s.episodes), s.steps, 100 * s.share, s.p_value),
            )
            for s in self.slices
        ]
        return [Table(f"Slices with a larger {self.title}", columns, rows)]


def find_slices(
    checkpoint: Checkpoint,
    data: Episodes,
    episodes: Iterable[int],
    *,
    by: str = "error",
    alpha: float = ALPHA,
    faults: Faults = NO_FAULTS,
    seed: int = 0,
    particles: int = 300,
    progress: Callable[[float], None] = lambda share: None,
) -> ErrorSlices:
    """Run a filter over episodes of a data set and search slices in which a score is larger.

    Args:
        by: one of ``scores_of(checkpoint.task)``. alpha: see ``ErrorSlices``.
        progress: called with the completed fraction, 0..1.

    Raises BadInput for too few episodes, an unknown score, one that does not apply, and as ``trace``.
    """
    find_score(by, checkpoint.task)
    indices = list(episodes)
    check_episodes(len(indices))
    settings: dict[str, Any] = {"faults": faults, "seed": seed, "particles": particles}
    runs = trace_all(checkpoint, data, indices, **settings, progress=lambda share: progress(0.8 * share))
    return slices_of(runs, by, alpha=alpha, progress=lambda share: progress(0.8 + 0.2 * share))


def slices_of(
    traces: Iterable[Trace],
    by: str = "error",
    *,
    alpha: float = ALPHA,
    progress: Callable[[float], None] = lambda share: None,
) -> ErrorSlices:
    """Search slices of the counted steps of the traces of one filter, which are not kept.

    Raises BadInput for an unknown score, one that does not apply, and as ``Survey.from_episodes``.
    """
    parts: list[tuple[EpisodeScores, EpisodeCovariates]] = []
    for trace in traces:
        if not parts:  # before all of them are computed
            check_applies(by, find_score(by, trace.task).why_not(trace))
        parts.append((EpisodeScores.from_trace(trace), EpisodeCovariates.from_trace(trace)))
    if not parts:
        raise BadInput("the search for slices needs at least one trace")
    survey = Survey.from_episodes(scores for scores, _ in parts)
    return slices_of_survey(survey, [covariates for _, covariates in parts], by, alpha=alpha, progress=progress)


def check_episodes(count: int) -> None:
    """Raise BadInput if a search in this number of episodes is unlikely to find a slice."""
    if count < MIN_SEARCHED:
        raise BadInput(f"{plural(count, 'episode')}; a search for slices needs at least {MIN_SEARCHED}")


def describe_slices(survey: Survey, episodes: Sequence[EpisodeCovariates], by: str) -> dict[str, Any]:
    """The slices of a score as JSON values, or why they were not searched."""
    try:
        check_episodes(len(episodes))
        if len(survey.step) > MAX_STEPS:
            raise BadInput(f"{len(survey.step)} steps; slices are searched in at most {MAX_STEPS}")
        slices = slices_of_survey(survey, episodes, by)
    except BadInput as error:
        return {"summary": f"Slices were not searched: {error}.", "rows": []}
    return {"summary": slices.summary, "rows": as_json(slices.slices)}


def slices_of_survey(
    survey: Survey,
    episodes: Iterable[EpisodeCovariates],
    by: str = "error",
    *,
    alpha: float = ALPHA,
    progress: Callable[[float], None] = lambda share: None,
) -> ErrorSlices:
    """Search slices of the counted steps of a survey.

    The search compares ranks. Slices whose ratio of means has an interval that contains 1 are omitted.

    Args:
        episodes: covariates of all episodes of the survey.

    Raises BadInput for an unknown score, one that does not apply, and one that is not finite.
    """
    runs = fields_of_runs(survey, by)
    ordered = sorted(episodes, key=lambda episode: episode.index)
    keep = np.concatenate([episode.counted for episode in ordered])
    score, episode, step = survey.scores[by][keep], survey.episode[keep], survey.step[keep]
    if not np.isfinite(score).all():
        raise BadInput(f"no slices by {by}: the score is not finite at {np.sum(~np.isfinite(score))} steps")
    covariates = join_covariates(ordered)
    candidates = find_candidates(score, episode, covariates, alpha=alpha, seed=survey.seed, progress=progress)
    slices: list[ErrorSlice] = []
    for candidate in candidates:
        opened = [slice_.worst[0] for slice_ in slices]
        slice_ = _error_slice(candidate, score, episode, step, opened)
        if not slice_.low <= 1.0:
            slices.append(slice_)
    return ErrorSlices(
        **runs,
        alpha=alpha,
        episodes=len(ordered),
        steps=len(score),
        covariates=tuple(covariate.name for covariate in covariates),
        slices=tuple(slices),
    )


def _error_slice(candidate: Candidate, score: Array, episode: Index, step: Index, opened: Sequence[int]) -> ErrorSlice:
    """Effect of a slice with its interval over episodes.

    episode, step: (S,) indices. opened: episodes of the worst steps of the slices above.
    """
    inside = candidate.steps
    unopened = inside & ~np.isin(episode, opened)
    worst = int(np.where(unopened if unopened.any() else inside, score, -np.inf).argmax())
    indices, number = np.unique(episode, return_inverse=True)
    columns = np.stack([inside, ~inside, inside * score, ~inside * score], axis=1)
    sums = np.zeros((len(indices), 4))
    np.add.at(sums, number, columns)

    def log_ratio(total: Array) -> Array:
        mean = total[..., 2:] / np.maximum(total[..., :2], 1.0)
        result: Array = np.diff(np.log(np.maximum(mean[..., ::-1], 1e-12)), axis=-1)[..., 0]
        return result

    ratio, low, high = (float(np.exp(value)) for value in jackknife(sums, log_ratio))
    return ErrorSlice(
        conditions=candidate.conditions,
        inside=float(score[inside].mean()),
        outside=float(score[~inside].mean()),
        ratio=ratio,
        low=low,
        high=high,
        episodes=tuple(indices[np.unique(number[inside])].tolist()),
        worst=(int(episode[worst]), int(step[worst])),
        steps=int(inside.sum()),
        share=float(inside.mean()),
        p_value=candidate.p_value,
    )

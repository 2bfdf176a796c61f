"""Where a filter fails: moments over a whole data set, the worst first, by what was happening at them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.faults.injection import WHOLE, Faults
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.evaluate import UNITS
from beliefscope.inspect.diagnostics.base import Array, Diagnostic, Line, Plot, Table, Value
from beliefscope.inspect.failures.step_scores import GROUPS, RECENT, Score, Survey, scores_of
from beliefscope.inspect.statistics.measures import Mask
from beliefscope.inspect.trace import Trace, trace

HIGH = 0.9
"""A step's score is high above this quantile of all steps' scores."""

TELLING = 0.05
"""A group stands out where chance would give it as many moments less often than this, over all groups."""

SHOWN = 20
"""Moments that a table shows."""

SHARES = np.linspace(0.0, 1.0, 51)


@dataclass(frozen=True)
class Moment:
    """A stretch of high steps, and the numbers at its peak; SI units.

    Attributes:
        episode: index in the data set. first, last, step: its steps, and the peak among them.
        score: at the peak, in the ``unit`` of its ``Failures``. scores: all scores there, by name.
        group: what was happening at the peak. also: what else was.
        error: (L,) m by layer. angle_error: (L, A) rad. nees: (L,).
        ess: effective sample size. beta, acting: (K,). None where the filter has none.
    """

    episode: int
    first: int
    last: int
    step: int
    score: float
    group: str
    also: tuple[str, ...]
    scores: dict[str, float]
    error: Array
    angle_error: Array
    nees: Array
    ess: float | None
    beta: Array | None
    acting: Array | None


@dataclass(frozen=True)
class Group:
    """The steps of one of ``GROUPS``, against all others.

    Attributes:
        steps, moments: how many; a moment is in the group of its peak. share, failures: the same as shares of all.
        lift: ``failures / share``: how many times more often it fails there than anywhere.
        chance: of so many moments or more, were each at a step drawn from all.
        inside, outside: mean score of its steps, and of all others.
    """

    name: str
    steps: int
    moments: int
    share: float
    failures: float
    lift: float
    chance: float
    inside: float
    outside: float


@dataclass(frozen=True)
class Failures(Diagnostic):
    """Moments of a data set's episodes at which a filter's score is high; SI units.

    Attributes:
        task, filter, checkpoint_hash, faults, seed, particles: what was traced.
        by: name of the score. title, unit: of it: m, rad, sigma, x (times) or none.
        threshold: above which a score is high. episodes, steps: how many were looked at.
        layers: the K modalities, then ``fused``: L. angles: names of the A components in rad.
        groups: those that have steps, in the order of ``GROUPS``.
        moments: all of them, the highest score first.
        quantiles: group -> (51,) of its steps' scores, from the least to the greatest; ``all`` too.
    """

    task: str
    filter: str
    checkpoint_hash: str
    faults: str
    seed: int
    particles: int | None
    by: str
    title: str
    unit: str
    threshold: float
    episodes: int
    steps: int
    layers: tuple[str, ...]
    angles: tuple[str, ...]
    groups: tuple[Group, ...]
    moments: tuple[Moment, ...]
    quantiles: Mapping[str, Array]

    @property
    def telling(self) -> list[Group]:
        """Groups with more moments than chance gives them, the highest lift first."""
        limit = TELLING / max(1, len(self.groups))
        return sorted((g for g in self.groups if g.lift > 1 and g.chance < limit), key=lambda g: -g.lift)

    @property
    def verdict(self) -> str:
        """How many, the worst, and what most of them have in common."""
        over = f"of {self.episodes} episode{'s' * (self.episodes != 1)}, {self.steps} steps, by {self.title}"
        if not self.moments:
            return f"No moment {over} stands out."
        worst = self.moments[0]
        where = f"{self.shown(worst.score)} at step {worst.step} of episode {worst.episode} ({worst.group})"
        count = f"{len(self.moments)} moment{'s' * (len(self.moments) != 1)} {over}, above {self.shown(self.threshold)}"
        causes = "; ".join(
            f"{g.name}: {_percent(g.share)} of steps, {_percent(g.failures)} of failures, {g.lift:.1f} x"
            for g in self.telling
        )
        return f"{count}; the worst, {where}. " + (
            f"{causes[0].upper()}{causes[1:]}." if causes else "No kind of step fails more often than chance has it."
        )

    def worst(self, top: int | None = None, group: str | None = None) -> tuple[Moment, ...]:
        """The ``top`` worst moments, of one group or of all. Raises BadInput for an unknown group."""
        if group is not None and group not in GROUPS:
            raise one_of("group", group, GROUPS)
        return tuple(moment for moment in self.moments if group in (None, moment.group))[:top]

    def shown(self, value: float) -> str:
        """A score as people read it: in cm or degrees, with its unit."""
        unit, factor = self._display
        return f"{value * factor:.3g} {unit}".rstrip()

    def tables(self) -> list[Table]:
        return [self.table_of_groups(), self.table_of(self.worst(SHOWN))]

    def table_of_groups(self) -> Table:
        """A line a group."""
        factor = self._display[1]
        columns = ("group", "steps %", "failures", "failures %", "lift x", "chance", "mean inside", "mean outside")
        rows = [
            (
                g.name,
                100 * g.share,
                g.moments,
                100 * g.failures,
                g.lift,
                g.chance,
                factor * g.inside,
                factor * g.outside,
            )
            for g in self.groups
        ]
        return Table(f"What was happening: {self._named}", columns, tuple(rows))

    def table_of(self, moments: Sequence[Moment]) -> Table:
        """A line a moment: where, its score, what was happening, and the numbers at its peak."""
        columns = ("episode", "step", "from", "to", self._named, "group", *(f"{layer} cm" for layer in self.layers))
        columns += tuple(f"{name.replace('_', ' ')} deg" for name in self.angles)
        columns += ("NEES", *(("ESS",) if self.particles else ()))
        columns += tuple(f"{layer} share %" for layer in self.layers[:-1] if len(self.layers) > 2)
        return Table("The worst moments", columns, tuple(map(self._row, moments)))

    def _row(self, m: Moment) -> tuple[Value, ...]:
        numbers = [*(100.0 * m.error), *np.degrees(m.angle_error[-1]), m.nees[-1]]
        numbers += ([m.ess] if self.particles else []) + ([] if m.acting is None else [*(100.0 * m.acting)])
        known = (float(value) if np.isfinite(value) else None for value in numbers)
        return (m.episode, m.step, m.first, m.last, self._display[1] * m.score, m.group, *known)

    @property
    def _display(self) -> tuple[str, float]:
        """Unit of the score as people read it, and the factor to it."""
        return UNITS.get(self.unit, (self.unit, 1.0))

    @property
    def _named(self) -> str:
        return f"{self.title} ({self._display[0]})" if self.unit else self.title

    def plots(self) -> list[Plot]:
        """How the score is distributed over all steps, and over those of the groups that fail most often."""
        worst = sorted((g for g in self.groups if g.moments), key=lambda g: -g.lift)[:3]
        names = {"all steps": "all"} | {g.name: g.name for g in worst}
        lines = tuple(
            Line(name, self._display[1] * self.quantiles[key], 100.0 * (1.0 - SHARES), "fused" if key == "all" else key)
            for name, key in names.items()
        )
        return [Plot(f"{self.title} by what was happening", self._named, "steps with at least as much (%)", lines)]


def find_failures(
    checkpoint: Checkpoint,
    data: Dataset | Mapping[int, Episode] | Sequence[Episode],
    episodes: Iterable[int] | None = None,
    *,
    by: str = "error",
    faults: Faults = WHOLE,
    seed: int = 0,
    particles: int = 300,
    progress: Callable[[float], None] | None = None,
) -> Failures:
    """Runs a filter over a data set, episode by episode as the page does, and ranks its moments.

    Args:
        episodes: indices in ``data``; without them those that a ``Dataset`` holds out, or all.
        by: one of ``scores_of(checkpoint.task)``. progress: called with the share done, 0..1.

    Raises BadInput for a score that there is not, or as ``trace`` does.
    """
    _known(by, checkpoint.task)
    if episodes is None and isinstance(data, Dataset):
        episodes = data.held_out()
    elif episodes is None:
        episodes = data if isinstance(data, Mapping) else range(len(data))
    found = survey_of(checkpoint, data, episodes, faults=faults, seed=seed, particles=particles, progress=progress)
    return failures_of(found, by)


def survey_of(
    checkpoint: Checkpoint,
    data: Dataset | Mapping[int, Episode] | Sequence[Episode],
    episodes: Iterable[int],
    *,
    faults: Faults = WHOLE,
    seed: int = 0,
    particles: int = 300,
    progress: Callable[[float], None] | None = None,
) -> Survey:
    """Runs a filter over episodes of a data set, one by one, as the page does. Raises BadInput as ``trace``."""
    chosen = list(episodes)

    def traces() -> Iterator[Trace]:
        for done, index in enumerate(chosen):
            yield trace(checkpoint, data[index], index, seed, particles, faults, _part(progress, done, len(chosen)))

    return Survey.of(traces())


def failures_of(survey: Survey, by: str = "error") -> Failures:
    """Ranks the moments of a survey. Raises BadInput for a score that the filter has not, with the reason."""
    kind = _known(by, survey.task)
    if by in survey.refused:
        raise BadInput(f"no failures by {by}: {survey.refused[by]}")
    score = survey.scores[by]
    threshold = float(np.nanquantile(score, HIGH)) if np.isfinite(score).any() else np.nan
    recent = max(1, round(RECENT / survey.task.dt))
    group = survey.group
    spans = stretches(score > threshold, survey.episode, recent)
    moments = [_moment(survey, score, first, last) for first, last in spans]
    moments.sort(key=lambda m: (-m.score, m.episode, m.step))
    quantiles = {"all": _quantiles(score)}
    quantiles |= {name: _quantiles(score[group == i]) for i, name in enumerate(GROUPS) if (group == i).any()}
    return Failures(
        task=survey.task.name,
        filter=survey.filter,
        checkpoint_hash=survey.checkpoint_hash,
        faults=survey.faults,
        seed=survey.seed,
        particles=survey.particles,
        by=by,
        title=kind.title,
        unit=kind.unit,
        threshold=threshold,
        episodes=len(np.unique(survey.episode)),
        steps=len(score),
        layers=survey.layers,
        angles=survey.angles,
        groups=tuple(_group(name, group == i, score, moments) for i, name in enumerate(GROUPS) if (group == i).any()),
        moments=tuple(moments),
        quantiles=quantiles,
    )


def stretches(high: Mask, episode: NDArray[np.int_], bridge: int) -> list[tuple[int, int]]:
    """First and last index of each stretch of high steps, gaps of up to ``bridge`` steps bridged, episodes apart.

    No two of one episode overlap, nor come closer than ``bridge`` steps: non-maximum suppression, since a stretch has
    one peak. Arrays are (S,), episodes end to end.
    """
    at = np.flatnonzero(high)
    if not len(at):
        return []
    apart = (np.diff(at) > bridge + 1) | (np.diff(episode[at]) != 0)
    firsts, lasts = at[np.r_[True, apart]], at[np.r_[apart, True]]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def _moment(survey: Survey, score: Array, first: int, last: int) -> Moment:
    peak = first + int(np.nanargmax(score[first : last + 1]))
    holds = [name for name in GROUPS if survey.happening[name][peak]]

    def at(array: Array | None) -> Array | None:
        return None if array is None else array[peak]

    return Moment(
        episode=int(survey.episode[peak]),
        first=int(survey.step[first]),
        last=int(survey.step[last]),
        step=int(survey.step[peak]),
        score=float(score[peak]),
        group=holds[0],
        also=tuple(holds[1:]),
        scores={name: float(values[peak]) for name, values in survey.scores.items()},
        error=survey.error[peak],
        angle_error=survey.angle_error[peak],
        nees=survey.nees[peak],
        ess=None if survey.ess is None else float(survey.ess[peak]),
        beta=at(survey.beta),
        acting=at(survey.acting),
    )


def _group(name: str, inside: Mask, score: Array, moments: Sequence[Moment]) -> Group:
    share = float(inside.mean())
    count = sum(moment.group == name for moment in moments)
    failures = count / len(moments) if moments else 0.0
    return Group(
        name=name,
        steps=int(inside.sum()),
        moments=count,
        share=share,
        failures=failures,
        lift=failures / share,
        chance=float(bdtrc(count - 1, len(moments), share)),
        inside=_mean(score[inside]),
        outside=_mean(score[~inside]),
    )


def _known(by: str, task: Task) -> Score:
    known = scores_of(task)
    if by not in known:
        raise one_of(f"score of task {task.name!r}", by, known)
    return known[by]


def _part(progress: Callable[[float], None] | None, done: int, count: int) -> Callable[[float], None] | None:
    return None if progress is None else lambda share: progress((done + share) / count)


def _mean(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else np.nan


def _quantiles(values: Array) -> Array:
    finite = values[np.isfinite(values)]
    return np.quantile(finite, SHARES) if len(finite) else np.full(len(SHARES), np.nan)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"

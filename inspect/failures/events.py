"""Failure search: ranked events over a data set, and their distribution over phases."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from beliefscope.datasets.episode import step_text
from beliefscope.datasets.errors import unknown_name
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.task import display_name, with_unit
from beliefscope.datasets.text import percent, plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Engine, Progress
from beliefscope.inspect.diagnostics.views import Array, Line, Plot, Table, Value, known_number
from beliefscope.inspect.failures.step_scores import RECENT, ROUNDING, Survey
from beliefscope.inspect.failures.survey import (
    ScoredRuns,
    fields_of_runs,
    find_score,
    held_out_or_all,
    survey_of,
)
from beliefscope.inspect.statistics.measures import UPDATES_NOTE, Mask, known_mean, layer_label
from beliefscope.inspect.traces.batch import Episodes

HIGH = 0.9
"""Quantile of the scores of all steps above which a step is part of an event."""

SIGNIFICANCE = 0.05
"""Significance level of over-represented phases, with Bonferroni correction."""

MAX_ROWS = 20
"""Maximum number of events in the table."""

UPDATE_SCORES = ("disagreement", "regret")
"""Scores that compare modalities by their updates."""

PROBABILITIES = np.linspace(0.0, 1.0, 51)


@dataclass(frozen=True)
class Event:
    """Consecutive steps with a high score, and values at the step with the highest score (peak); SI units.

    Attributes:
        episode: index in the data set.
        first, last, step: first and last step, and the peak.
        first_time, last_time, time: s from the first step of the episode to them; None without timestamps.
        score: score at the peak, in the ``unit`` of its ``Failures``.
        phase: phase of the peak.
        other_phases: other phases that apply to the peak.
        scores: all scores at the peak by name.
        error: (L,) main error by layer.
        angle_error: (L, A) rad.
        nees: (L,) NEES / n.
        ess: effective sample size, or None.
        beta, effective_weights: (K,), or None.
    """

    episode: int
    first: int
    last: int
    step: int
    first_time: float | None
    last_time: float | None
    time: float | None
    score: float
    phase: str
    other_phases: tuple[str, ...]
    scores: dict[str, float]
    error: Array
    angle_error: Array
    nees: Array
    ess: float | None
    beta: Array | None
    effective_weights: Array | None


@dataclass(frozen=True)
class PhaseStatistics:
    """Events of one phase in comparison with all steps.

    Attributes:
        name: one of ``phases_of`` the task.
        steps, events: number of steps, and of events whose peak is in the phase.
        share, event_share: shares of all steps with a score, and of all events.
        lift: ``event_share / share``, the relative frequency of events in the phase.
        p_value: probability of at least this number of events if peaks were uniform over all steps (binomial).
        inside, outside: mean score of the steps in the phase, and of all others.
    """

    name: str
    steps: int
    events: int
    share: float
    event_share: float
    lift: float
    p_value: float
    inside: float
    outside: float


@dataclass(frozen=True)
class Failures(ScoredRuns):
    """Events of a data set with high scores; SI units.

    Attributes:
        error_conversion: unit for display of the main error, and its factor.
        threshold: minimum score of an event.
        episodes, steps: numbers of episodes and steps.
        timed: whether steps have times.
        layers: L names: the K modalities, then ``fused``.
        angles: names of the A components in rad.
        phase_names: of the survey. phases: statistics of phases with steps, in the order of ``phase_names``.
        events: all events, highest score first.
        quantiles: phase or ``all`` -> (51,) quantiles of the scores, ascending.
    """

    error_conversion: tuple[str, float]
    threshold: float
    episodes: int
    steps: int
    timed: bool
    layers: tuple[str, ...]
    angles: tuple[str, ...]
    phase_names: tuple[str, ...]
    phases: tuple[PhaseStatistics, ...]
    events: tuple[Event, ...]
    quantiles: Mapping[str, Array]

    @property
    def over_represented(self) -> list[PhaseStatistics]:
        """Phases with significantly more events than expected, highest lift first."""
        limit = SIGNIFICANCE / max(1, len(self.phases))
        return sorted((p for p in self.phases if p.lift > 1 and p.p_value < limit), key=lambda p: -p.lift)

    @property
    def verdict(self) -> str:
        """Number of events, the worst event, and over-represented phases."""
        scope = f"in {plural(self.episodes, 'episode')}, {plural(self.steps, 'step')}, by {self.title}"
        if not self.events:
            return f"No events {scope}."
        worst = self.events[0]
        where = f"{step_text(worst.step, worst.time)} of episode {worst.episode} ({worst.phase})"
        count = f"{plural(len(self.events), 'event')} {scope}, above {self.format(self.threshold)}"
        phases = "; ".join(
            f"{p.name}, {percent(p.share)} of steps and {percent(p.event_share)} of events (lift {p.lift:.1f})"
            for p in self.over_represented
        )
        sentences = [f"{count}; worst: {self.format(worst.score)} at {where}."]
        sentences.append(f"Over-represented: {phases}." if phases else "No phase is over-represented.")
        sentences += [UPDATES_NOTE] if self.by in UPDATE_SCORES else []
        return " ".join(sentences)

    def worst(self, top: int | None = None, phase: str | None = None) -> tuple[Event, ...]:
        """The ``top`` worst events, of one phase or of all. Raises BadInput for an unknown phase."""
        if phase is not None and phase not in self.phase_names:
            raise unknown_name("phase", phase, self.phase_names)
        return tuple(event for event in self.events if phase in (None, event.phase))[:top]

    def format(self, value: float) -> str:
        """A score in its display unit."""
        unit, factor = self.conversion
        return f"{value * factor:z.3g} {unit}".rstrip()

    def tables(self) -> list[Table]:
        return [self.phase_table(), self.event_table(self.worst(MAX_ROWS))]

    def phase_table(self) -> Table:
        """One row per phase."""
        factor = self.conversion[1]
        rows = [
            {
                "phase": g.name,
                "steps (%)": 100 * g.share,
                "events": g.events,
                "events (%)": 100 * g.event_share,
                "lift": g.lift,
                "p-value": g.p_value,
                "mean inside": factor * g.inside,
                "mean outside": factor * g.outside,
            }
            for g in self.phases
        ]
        return Table.from_rows(f"Events by phase: {self._label}", rows)

    def event_table(self, events: Sequence[Event]) -> Table:
        """One row per event with the values at its peak; updates that the filter does not report have no column."""
        known = [i for i, n in enumerate(self.layers) if n == "fused" or any(np.isfinite(e.error[i]) for e in events)]
        columns: tuple[str, ...] = ("episode", "step", "from", "to")
        columns += ("time (s)", "from (s)", "to (s)") if self.timed else ()
        columns += (self._label, "phase")
        columns += tuple(with_unit(layer_label(self.layers[i]), self.error_conversion[0]) for i in known)
        columns += tuple(f"{display_name(name)} (deg)" for name in self.angles)
        columns += ("NEES/n", *(("ESS",) if self.particles else ()))
        if any(event.effective_weights is not None for event in events):
            columns += tuple(f"effective weight of {display_name(layer)} (%)" for layer in self.layers[:-1])
        return Table("Worst events", columns, [self._row(event, known) for event in events])

    def _row(self, event: Event, known: list[int]) -> tuple[Value, ...]:
        numbers = [*(self.error_conversion[1] * event.error[known]), *np.degrees(event.angle_error[-1]), event.nees[-1]]
        numbers += [event.ess] if self.particles else []
        numbers += [] if event.effective_weights is None else [*(100.0 * event.effective_weights)]
        score = self.conversion[1] * event.score
        times = (event.time, event.first_time, event.last_time) if self.timed else ()
        steps = (event.episode, event.step, event.first, event.last, *times)
        return (*steps, score, event.phase, *map(known_number, numbers))

    @property
    def _label(self) -> str:
        return with_unit(self.title, self.conversion[0])

    def plots(self) -> list[Plot]:
        """Distribution of the score over all steps and over the phases with the highest lift."""
        worst = sorted((g for g in self.phases if g.events), key=lambda g: -g.lift)[:3]
        names = {"all steps": "all"} | {g.name: g.name for g in worst}
        lines = tuple(
            Line(
                name,
                self.conversion[1] * self.quantiles[key],
                100.0 * (1.0 - PROBABILITIES),
                "fused" if key == "all" else key,
            )
            for name, key in names.items()
        )
        return [Plot(f"{self.title} by phase", self._label, "steps with at least this value (%)", lines)]


def find_failures(
    checkpoint: Checkpoint,
    data: Episodes,
    episodes: Iterable[int] | None = None,
    *,
    by: str = "error",
    faults: Faults = NO_FAULTS,
    seed: int = 0,
    particles: int = 300,
    engine: Engine = "local",
    workers: int = 1,
    progress: Progress = None,
) -> Failures:
    """Run a filter over the episodes of a data set and rank its failures.

    Args:
        episodes: indices in ``data``; by default the held-out episodes of a ``Dataset``, otherwise all.
        by: one of ``scores_of(checkpoint.task)``.
        engine, workers: as for ``survey_of``.
        progress: called with the completed fraction, 0..1.

    Raises BadInput for an unknown score, and as ``trace``.
    """
    find_score(by, checkpoint.task)
    survey = survey_of(
        checkpoint,
        data,
        held_out_or_all(data) if episodes is None else episodes,
        by=by,
        faults=faults,
        seed=seed,
        particles=particles,
        engine=engine,
        workers=workers,
        progress=progress,
    )
    return failures_of(survey, by)


def failures_of(survey: Survey, by: str = "error") -> Failures:
    """Rank the events of a survey. Raises BadInput with the reason for a score that does not apply."""
    runs = fields_of_runs(survey, by)
    score = survey.scores[by]
    threshold = float(np.nanquantile(score, HIGH)) if np.isfinite(score).any() else np.nan
    gap = max(1, round(RECENT / survey.task.dt))
    has_score = np.isfinite(score) | ~np.isfinite(score).any()
    phase = np.where(has_score, survey.phase_index, -1)
    spans = event_spans(score > threshold, survey.episode, gap, survey.position)
    events = [_event(survey, score, first, last) for first, last in spans]
    events.sort(key=lambda event: (-event.score, event.episode, event.step))
    quantiles = {"all": _quantiles(score)}
    quantiles |= {name: _quantiles(score[phase == i]) for i, name in enumerate(survey.phases) if (phase == i).any()}
    return Failures(
        **runs,
        error_conversion=survey.task.main_error.conversion,
        threshold=threshold,
        episodes=len(np.unique(survey.episode)),
        steps=len(score),
        timed=survey.time is not None,
        layers=survey.layers,
        angles=survey.angles,
        phase_names=tuple(survey.phases),
        phases=tuple(
            _phase_statistics(name, (phase == i)[has_score], score[has_score], events)
            for i, name in enumerate(survey.phases)
            if (phase == i).any()
        ),
        events=tuple(events),
        quantiles=quantiles,
    )


def event_spans(high: Mask, episode: NDArray[np.int_], gap: int, position: Array) -> list[tuple[int, int]]:
    """First and last index of each interval of high steps, merged across gaps of up to ``gap`` steps in an episode.

    Since each interval has one peak, this is a non-maximum suppression. Arrays are (S,) over concatenated episodes;
    those of ``position`` are ``Episode.positions``.
    """
    at = np.flatnonzero(high)
    if not len(at):
        return []
    # Neighbouring steps are one interval, however long the time between them.
    breaks = ((np.diff(position[at]) > gap + 1 + ROUNDING) & (np.diff(at) > 1)) | (np.diff(episode[at]) != 0)
    firsts, lasts = at[np.r_[True, breaks]], at[np.r_[breaks, True]]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def _event(survey: Survey, score: Array, first: int, last: int) -> Event:
    peak = first + int(np.nanargmax(score[first : last + 1]))
    phases = [name for name, mask in survey.phases.items() if mask[peak]]

    def at(array: Array | None) -> Array | None:
        return None if array is None else array[peak]

    return Event(
        episode=int(survey.episode[peak]),
        first=int(survey.step[first]),
        last=int(survey.step[last]),
        step=int(survey.step[peak]),
        first_time=survey.time_of(first),
        last_time=survey.time_of(last),
        time=survey.time_of(peak),
        score=float(score[peak]),
        phase=phases[0],
        other_phases=tuple(phases[1:]),
        scores={name: float(values[peak]) for name, values in survey.scores.items()},
        error=survey.error[peak],
        angle_error=survey.angle_error[peak],
        nees=survey.nees[peak],
        ess=None if survey.ess is None else float(survey.ess[peak]),
        beta=at(survey.beta),
        effective_weights=at(survey.effective_weights),
    )


def _phase_statistics(name: str, inside: Mask, score: Array, events: Sequence[Event]) -> PhaseStatistics:
    share = float(inside.mean())
    count = sum(event.phase == name for event in events)
    event_share = count / len(events) if events else 0.0
    return PhaseStatistics(
        name=name,
        steps=int(inside.sum()),
        events=count,
        share=share,
        event_share=event_share,
        lift=event_share / share,
        p_value=float(bdtrc(count - 1, len(events), share)),
        inside=known_mean(score[inside]),
        outside=known_mean(score[~inside]),
    )


def _quantiles(values: Array) -> Array:
    finite = values[np.isfinite(values)]
    return np.quantile(finite, PROBABILITIES) if len(finite) else np.full(len(PROBABILITIES), np.nan)

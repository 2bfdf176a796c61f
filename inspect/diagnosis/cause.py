"""Causes of faults: a catalog entry states which statistics a fault changes, how to undo it and what to do next."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import translate
from functools import cache
from typing import Any, Literal

from beliefscope.datasets.text import percent
from beliefscope.inspect.diagnostics.views import Table, html_result


@dataclass(frozen=True)
class Symptom:
    """Statistics that a fault changes directly.

    Attributes:
        statistics: patterns of names ``KIND/SUBJECT/PHASE``, joined by ``|``; ``*`` matches any text.
        direction: 1 if they increase, -1 if they decrease, 0 for either.
        weight: relative to the other symptoms of the cause.
        target: how the statistics together must deviate: ``mirrored``, to the healthy values with the opposite sign;
            ``shifted``, all by the same amount; ``common``, those of all modalities by the same amount in each
            component; ``alone``, the opposite of ``common``; ``shrunk``, towards zero and not beyond; ``exchanged``,
            those of some subjects to each other's healthy values.
        otherwise: symptoms that may occur in its place. unmeasured: those in its place if it has no statistic.
        optional: whether it counts only where it can be observed.
    """

    statistics: str
    direction: Literal[-1, 0, 1] = 1
    weight: float = 1.0
    target: Literal["", "mirrored", "shifted", "common", "alone", "shrunk", "exchanged"] = ""
    otherwise: tuple[Symptom, ...] = ()
    unmeasured: tuple[Symptom, ...] = ()
    optional: bool = False

    def matches(self, statistic: str) -> bool:
        """Whether a statistic belongs to the symptom or those in its place, whatever its value."""
        others = (*self.otherwise, *self.unmeasured)
        return matches(self.statistics, statistic) or any(other.matches(statistic) for other in others)


def matches(patterns: str, statistic: str) -> bool:
    """Whether the name of a statistic matches one of the patterns, which are joined by ``|``."""
    return _regex(patterns).match(statistic) is not None


@cache
def _regex(patterns: str) -> re.Pattern[str]:
    return re.compile("|".join(map(translate, patterns.split("|"))))


@dataclass(frozen=True)
class Command:
    """A command that does the next action of a cause; its task, filter and data are added.

    Attributes:
        name: such as ``finetune``. options: its other options. train: preset of the modules that it trains.
    """

    name: str
    options: str = ""
    train: str = ""


@dataclass(frozen=True)
class Cause:
    """A cause of faults and its signature.

    Attributes:
        name: ``component.mechanism``, such as ``image.frozen`` or ``model.image.bias``.
        title: what has happened, such as ``Image frozen``; start of the headline.
        symptoms: deviations that the cause always produces.
        consequences: patterns of statistics that it may change as well.
        lowers: patterns of statistics that it may decrease, but not increase.
        raises: patterns of statistics that it may increase, but not decrease.
        undo: names of interventions that undo it (``inspect/diagnosis/undo/undo.py``), joined by ``|``: the first one
            that is possible does; empty if there is none.
        next: next action; without its full stop if a command follows.
        prior: added to the score; negative for a cause that would explain almost everything.
        command: does the next action.
        by_hand: next action for external filters that the command cannot change, such as those without parameters.
    """

    name: str
    title: str
    symptoms: tuple[Symptom, ...]
    consequences: str
    next: str
    undo: str = ""
    lowers: str = ""
    raises: str = ""
    prior: float = 0.0
    command: Command | None = None
    by_hand: str = ""

    @property
    def component(self) -> str:
        """The faulty component: the name without the mechanism."""
        return self.name.rpartition(".")[0]


SHOWN = 0.05
"""Smallest probability of a cause in headlines, in tables and on the page."""


LARGEST = 0.99
"""Largest probability that is displayed as a number."""


def probability_text(probability: float) -> str:
    """A probability with two digits; none is certain."""
    return f"{probability:.2f}" if round(probability, 2) <= LARGEST else f"above {LARGEST}"


class Probability(float):
    """A probability in a table: displayed by ``probability_text``, with all digits in files."""

    def __format__(self, spec: str) -> str:
        return probability_text(float(self))


def removes_error(share: float) -> bool:
    """Whether an undo removes 1 % of the error or more, rounded."""
    return round(100.0 * share) > 0


@dataclass(frozen=True)
class Evidence:
    """A deviation that supports a cause.

    Attributes:
        text: statistic, value and healthy range in words.
        value, low, high: value of the statistic and its 95 % healthy range.
        episode, step: where it shows best; None if it concerns whole episodes.
        time: s from the first step to ``step``; None without timestamps.
        sensor: observation key of the sensor that it is about, or ``control``; empty if it is about something else.
    """

    text: str
    value: float
    low: float
    high: float
    episode: int | None = None
    step: int | None = None
    time: float | None = None
    sensor: str = ""


@dataclass(frozen=True)
class Recovery:
    """Effect of undoing a cause on the filter, by replay with the same random numbers.

    Attributes:
        error: share of the error that the undo removes; NaN without ground truth.
        low, high: 95 % interval over episodes; NaN for too few of them.
        nll: decrease of the negative log-likelihood by step, in nats: of the true state; without ground truth, of the
            virtual observations.
        measure: the error, such as ``position`` or ``angle``: that which falls most.
    """

    error: float
    low: float
    high: float
    nll: float
    measure: str


@dataclass(frozen=True)
class Candidate:
    """A ranked cause.

    Attributes:
        cause: catalog entry.
        probability: that it is present, alone or together with another cause.
        episodes: indices of the affected episodes.
        steps: first affected step and first step after it; None for complete episodes.
        evidence: deviations that support it, largest first.
        recovered: effect of undoing it; None if it was not undone.
        next: next action.
    """

    cause: Cause
    probability: float
    episodes: tuple[int, ...]
    steps: tuple[int, int] | None
    evidence: tuple[Evidence, ...]
    recovered: Recovery | None
    next: str

    def to_json(self) -> dict[str, Any]:
        """JSON values, except that numbers may be NaN."""
        return {
            "cause": self.cause.name,
            "title": self.cause.title,
            "component": self.cause.component,
            "probability": self.probability,
            "episodes": list(self.episodes),
            "steps": None if self.steps is None else list(self.steps),
            "evidence": [vars(evidence) for evidence in self.evidence],
            "recovered": None if self.recovered is None else vars(self.recovered),
            "next": self.next,
        }


@dataclass(frozen=True)
class Diagnosis:
    """Result of ``diagnose``.

    Attributes:
        state: ``healthy``; ``fault``: the first cause is probable; ``unsure``: a fault, whose cause is not certain.
        masked: whether there is a fault while the errors of the filter are in the healthy range.
        headline: one sentence.
        causes: most probable first; empty if healthy.
        deviations: largest ones, whatever their cause, also if healthy.
        provenance: task, filter, hash, episodes, healthy record, and what was compared and what was not.
        unmeasured: what the diagnosis could not judge, and therefore does not call healthy.
    """

    state: Literal["healthy", "fault", "unsure"]
    masked: bool
    headline: str
    causes: tuple[Candidate, ...]
    deviations: tuple[Evidence, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def unmeasured(self) -> tuple[str, ...]:
        return tuple(self.provenance.get("unmeasured", ()))

    @property
    def listed(self) -> tuple[Candidate, ...]:
        """The causes with evidence and a probability of at least ``SHOWN``."""
        return tuple(cause for cause in self.causes if cause.probability >= SHOWN and cause.evidence)

    def _repr_html_(self) -> str:
        """Headline and tables in a notebook."""
        return html_result(self.headline, self.tables())

    def to_json(self) -> dict[str, Any]:
        """JSON values, except that numbers may be NaN."""
        head = {"state": self.state, "masked": self.masked, "headline": self.headline}
        causes = [candidate.to_json() for candidate in self.causes]
        deviations = [vars(deviation) for deviation in self.deviations]
        return head | {"causes": causes, "deviations": deviations, **self.provenance}

    def tables(self) -> list[Table]:
        """The ranked causes, the evidence and next action of each, and what was not measured.

        The largest deviations take the place of causes if none is listed.
        """
        causes = self.listed
        unmeasured = tuple((text,) for text in self.unmeasured)
        missing = [Table("Not measured in these episodes", ("sensor or statistic",), unmeasured)] if unmeasured else []
        if not causes:
            largest = [((), deviation) for deviation in self.deviations]
            deviations = [_evidence_table("Largest deviations", (), largest)] if largest else []
            error = self.provenance.get("largest_error")
            heads = ("episode", "step", "size", "sources")
            worst = [Table("Largest error", heads, (tuple(error[name] for name in heads),))] if error else []
            return [*worst, *deviations, *missing]
        ranked = tuple(
            (c.cause.title, c.cause.name, Probability(c.probability), _share(c.recovered), index_ranges(c.episodes))
            for c in causes
        )
        actions = tuple((c.cause.title, c.next) for c in causes)
        rows = [((c.cause.title,), e) for c in causes for e in c.evidence]
        return [
            Table("Causes", ("cause", "name", "probability", "error removed by undoing it", "episodes"), ranked),
            _evidence_table("Evidence", ("cause",), rows),
            Table("Next", ("cause", "action"), actions),
            *missing,
        ]


def _evidence_table(title: str, heads: tuple[str, ...], rows: Sequence[tuple[tuple[str, ...], Evidence]]) -> Table:
    """A table of deviations, with their times where the data have timestamps. rows: first columns, and deviation."""
    timed = any(e.time is not None for _, e in rows)
    values = tuple((*first, e.text, e.episode, e.step, *((e.time,) if timed else ())) for first, e in rows)
    return Table(title, (*heads, "deviation", "episode", "step", *(("time (s)",) if timed else ())), values)


def index_ranges(indices: Sequence[int]) -> str:
    """Increasing indices as text, three and more consecutive ones as a range: ``3, 4, 9 to 12``."""
    runs: list[list[int]] = []
    for index in indices:
        if runs and index == runs[-1][-1] + 1:
            runs[-1].append(index)
        else:
            runs.append([index])
    return ", ".join(f"{r[0]} to {r[-1]}" if len(r) > 2 else ", ".join(map(str, r)) for r in runs)


def _share(recovery: Recovery | None) -> str:
    """Recovered share of the error with its interval, empty without one."""
    if recovery is None or math.isnan(recovery.error):
        return ""
    if not removes_error(recovery.error):  # most undos of sensors remove them
        return "none"
    share = percent(recovery.error)
    if not math.isnan(recovery.low):  # a single episode has no interval
        share += f" ({100 * recovery.low:z.0f} to {100 * recovery.high:z.0f})"
    return f"{share} of {recovery.measure}"

"""Probabilities of causes from the deviations of all statistics.

A cause must explain every deviation: its own symptoms must deviate in the right direction, and whatever it cannot
change must not. An unexplained deviation upstream, of a sensor or an equation, weighs most, since a fault downstream
cannot produce it; the filter's belief, at the end of the chain, is changed by everything. The t-values of deviations
are relative to their critical values (``with_critical_values``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, permutations

import numpy as np

from beliefscope.inspect.diagnosis.cause import Cause, Symptom, matches
from beliefscope.inspect.diagnosis.causes.consequences import FILTER
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.diagnostics.statistic_kinds import ADJUSTED
from beliefscope.inspect.statistics.measures import Array

NOISE, GROWTH = 0.7, 1.0
"""Ratio of a t-value to its critical value up to which a deviation does not count, and scale of its growth."""

OF_FILTER = 0.2
"""Weight of an unexplained deviation of the filter's belief; that of others is 1."""

TEMPERATURE = 0.15
"""Difference of scores that changes the odds of two causes by a factor of e; calibrated by ``bench/beliefbench``."""

UNKNOWN = -0.3
"""Score of a cause outside of the catalog, which explains nothing."""

PAIR = 0.3
"""Penalty of two causes at a time."""

MAX_ORDERS = 120
"""Maximum number of orders of subjects that may be exchanged."""


def strength(ratio: float) -> float:
    """Strength of a deviation, 0 to 1, from the ratio of its t-value to the critical value."""
    return max(0.0, 1.0 - math.exp((NOISE - ratio) / GROWTH))


def support(symptom: Symptom, deviations: Sequence[Deviation]) -> float:
    """How well its statistics agree with a symptom, or with one in its place, -1 to 1; -1 if none deviates."""
    own = [deviation for deviation in deviations if matches(symptom.statistics, deviation.statistic)]
    others = symptom.otherwise if own else (*symptom.otherwise, *symptom.unmeasured)
    best = max((support(other, deviations) for other in others), default=-1.0)
    if not own:
        return best
    sizes = [strength(abs(deviation.t)) for deviation in own]
    if symptom.target:
        return max(best, max(sizes) * (1.0 + _agreement(symptom.target, own)) - 1.0)
    agrees = (symptom.direction * deviation.t >= 0.0 for deviation in own)
    return max(best, 2.0 * max(size if yes else 0.0 for size, yes in zip(sizes, agrees, strict=True)) - 1.0)


def _agreement(target: str, deviations: Sequence[Deviation]) -> float:
    """How well values agree with a target, -1 to 1; 0 if they cannot tell. Adjusted values do not count."""
    deviations = [d for d in deviations if not d.statistic.endswith(f"/{ADJUSTED}")]
    if not deviations:
        return 0.0
    value, healthy, low, high = np.array([(d.value, d.healthy, d.low, d.high) for d in deviations]).T
    shift, width = value - healthy, np.maximum(high - low, 1e-9)
    if target == "shifted":  # a single statistic cannot contradict it
        unequal = float(np.ptp(shift) / max(np.abs(shift).mean(), 1e-9))
        return max(-1.0, 1.0 - 2.0 * unequal) if len(shift) > 1 else 0.0
    if target == "shrunk":
        weights = np.square([d.t for d in deviations])
        beyond = (np.abs(value) > np.abs(healthy)) | (value * healthy < -0.1 * np.square(healthy))
        return 1.0 - 2.0 * float((weights * beyond).sum() / max(weights.sum(), 1e-9))
    if target == "mirrored":
        # Statistics that hardly deviate may have no part in it.
        return _fit(deviations, -healthy, np.minimum(1.0, np.abs(healthy) / width))
    if target == "exchanged":
        return _exchange(deviations)
    # Log-likelihood ratio of equal shifts against a shift of the most precise modality only; the width is 4 sigma.
    ratio = 0.0
    components = [d.statistic.split("/")[1].rpartition(" ")[2] for d in deviations]
    for component in dict.fromkeys(components):
        index = np.flatnonzero([c == component for c in components])
        first, *others = index[np.argsort(width[index])]
        for k in others:
            sigma = np.hypot(width[k], width[first]) / 4.0
            ratio += float(shift[k] ** 2 - (shift[k] - shift[first]) ** 2) / (2.0 * sigma**2)
    return math.tanh(ratio if target == "common" else -ratio)


def _fit(deviations: Sequence[Deviation], expected: Array, weights: Array) -> float:
    """How well values agree with expected ones (D,), -1 to 1, by the squares of their t-values and further weights."""
    value, healthy, t = np.array([(d.value, d.healthy, d.t) for d in deviations]).T
    fits = np.maximum(1.0 - 2.0 * np.abs(value - expected) / np.maximum(np.abs(value - healthy), 1e-9), -1.0)
    weights = weights * np.square(t)
    return float((weights * fits).sum() / max(weights.sum(), 1e-9))


def _exchange(deviations: Sequence[Deviation]) -> float:
    """How well the values of subjects agree with each other's healthy values, in the best order but their own."""
    healthy = {deviation.statistic: deviation.healthy for deviation in deviations}
    names = [name.split("/") for name in healthy]
    subjects = tuple(dict.fromkeys(subject for _, subject, _ in names))
    best = -1.0
    for order in islice(permutations(subjects), 1, MAX_ORDERS):
        source = dict(zip(subjects, order, strict=True))
        expected = [healthy.get(f"{kind}/{source[x]}/{phase}", math.inf) for kind, x, phase in names]
        best = max(best, _fit(deviations, np.array(expected), np.ones(len(names))))
    return best


@dataclass(frozen=True)
class Explanation:
    """How well a cause explains all deviations.

    Attributes:
        component: of the cause.
        support: of its symptoms, -1 to 1, and of its prior and the effect of undoing it.
        unexplained: kind and subject of deviations that it does not explain -> strength of the largest.
    """

    component: str
    support: float
    unexplained: Mapping[str, float]

    @property
    def score(self) -> float:
        """Support minus the probability that an unexplained deviation is real, if they are independent."""
        return self.support - (1.0 - math.prod(1.0 - size for size in self.unexplained.values()))


def explain(cause: Cause, deviations: Iterable[Deviation]) -> Explanation:
    """Support of the symptoms of a cause, and the deviations that it leaves unexplained.

    Statistics of one kind and subject in several phases count once, by their largest deviation.
    """
    members: list[list[Deviation]] = [[] for _ in cause.symptoms]
    unexplained: dict[str, float] = {}
    for deviation in deviations:
        name = deviation.statistic
        hits = [i for i, symptom in enumerate(cause.symptoms) if symptom.matches(name)]
        for i in hits:
            members[i].append(deviation)
        one_way = cause.lowers if deviation.t < 0.0 else cause.raises
        if not hits and not matches(cause.consequences, name) and not matches(one_way, name):
            group = name.rpartition("/")[0]
            size = (OF_FILTER if matches(FILTER, name) else 1.0) * strength(abs(deviation.t))
            unexplained[group] = max(unexplained.get(group, 0.0), size)
    observed = [(s, group) for s, group in zip(cause.symptoms, members, strict=True) if group or not s.optional]
    weights = [symptom.weight for symptom, _ in observed]
    supports = [support(symptom, group) for symptom, group in observed]
    total = sum(w * s for w, s in zip(weights, supports, strict=True)) / sum(weights)
    return Explanation(cause.component, cause.prior + total, unexplained)


def probabilities(explanations: Mapping[str, Explanation]) -> dict[str, float]:
    """Probability that each cause is present: alone, together with another one, or neither of an unknown cause.

    A hypothesis is one cause, or two of different components, which have the mean of their supports and leave
    unexplained what neither explains. The probabilities are a softmax of the scores.
    """
    groups = sorted({group for explanation in explanations.values() for group in explanation.unexplained})
    left = np.array([[e.unexplained.get(group, 0.0) for group in groups] for e in explanations.values()])
    supports = np.array([e.support for e in explanations.values()])
    left = left.reshape(len(supports), len(groups))
    components = np.array([e.component for e in explanations.values()])
    excluded = (components[:, None] == components) | (components == "data") | (components == "data")[:, None]
    pairs = np.where(excluded, -np.inf, (supports[:, None] + supports) / 2.0 - PAIR)
    np.fill_diagonal(pairs, supports)
    scores = pairs - (1.0 - np.prod(1.0 - np.minimum(left[:, None], left), axis=-1))
    shares = np.exp((np.triu(scores) + np.tril(np.full_like(scores, -np.inf), -1)) / TEMPERATURE)
    shares /= shares.sum() + math.exp(UNKNOWN / TEMPERATURE)
    present = shares.sum(0) + shares.sum(1) - np.diagonal(shares)
    return dict(zip(explanations, present.tolist(), strict=True))


def burden(deviations: Iterable[Deviation]) -> float:
    """Sum of the strengths of all deviations, one by kind and subject; those of the filter count less."""
    largest: dict[str, float] = {}
    for deviation in deviations:
        group = deviation.statistic.rpartition("/")[0]
        weight = OF_FILTER if matches(FILTER, deviation.statistic) else 1.0
        largest[group] = max(largest.get(group, 0.0), weight * strength(abs(deviation.t)))
    return sum(largest.values())


def applicable(causes: Sequence[Cause], statistics: Iterable[str]) -> list[Cause]:
    """The causes whose symptoms can all be observed, except for optional ones."""
    names = list(statistics)
    return [c for c in causes if all(s.optional or any(s.matches(name) for name in names) for s in c.symptoms)]

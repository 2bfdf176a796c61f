"""Probabilities of causes from the deviations of all statistics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from beliefscope.inspect.diagnosis.cause import Cause, matches
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation

CERTAIN = 10.0
"""Ratio of a t-value to its critical value from which a deviation counts fully."""

TEMPERATURE = 0.15
"""Difference of scores that changes the odds of two causes by a factor of e; calibrated by ``bench/beliefbench``."""

UNKNOWN = -0.3
"""Score of a cause outside of the catalog, which explains nothing."""


def strength(ratio: float) -> float:
    """Strength of a deviation, 0 to 1, from the ratio of its t-value to the critical value."""
    return min(1.0, math.log1p(max(0.0, ratio - 0.5)) / math.log1p(CERTAIN - 0.5))


def score(cause: Cause, deviations: Iterable[Deviation], critical: float) -> float:
    """How well a cause explains all deviations, -1 to 1: strength of its symptoms minus the unexplained share.

    Statistics of one kind and subject in several phases count once, by their largest deviation. A symptom counts by its
    largest deviation in the right direction; one in the wrong direction, or none, counts against the cause.

    Args:
        critical: t-value from which a deviation is significant.
    """
    symptoms = [0.0] * len(cause.symptoms)
    total: dict[str, float] = {}
    unexplained: dict[str, float] = {}
    for deviation in deviations:
        name, size = deviation.statistic, strength(abs(deviation.t) / critical)
        group = name.rpartition("/")[0]
        total[group] = max(total.get(group, 0.0), size)
        explained = matches(cause.consequences, name)
        for i, symptom in enumerate(cause.symptoms):
            if symptom.matches(name):
                explained = True
                sign = symptom.direction * deviation.t >= 0.0
                symptoms[i] = max(symptoms[i], size) if sign else symptoms[i]
        if not explained:
            unexplained[group] = max(unexplained.get(group, 0.0), size)
    weights = [symptom.weight for symptom in cause.symptoms]
    support = sum(w * (2.0 * s - 1.0) for w, s in zip(weights, symptoms, strict=True)) / sum(weights)
    return support - sum(unexplained.values()) / max(1.0, sum(total.values()))


def probabilities(scores: Mapping[str, float], temperature: float = TEMPERATURE) -> dict[str, float]:
    """Softmax of scores, with an unknown cause in the denominator."""
    values = np.array([*scores.values(), UNKNOWN]) / temperature
    shares = np.exp(values - values.max())
    shares /= shares.sum()
    return dict(zip(scores, shares[:-1].tolist(), strict=True))


def applicable(causes: Sequence[Cause], statistics: Iterable[str]) -> list[Cause]:
    """The causes whose symptoms can all be observed."""
    names = list(statistics)
    return [c for c in causes if all(any(s.matches(name) for name in names) for s in c.symptoms)]

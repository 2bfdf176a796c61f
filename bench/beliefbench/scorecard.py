"""Score card: answers of a tool compared with the planted causes.

An answer is the JSON document of ``beliefscope diagnose``; only ``state``, ``masked``, and ``cause`` and
``probability`` of ``causes`` are used. Causes are ranked by their order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Answer = Mapping[str, Any]
Truth = Mapping[str, Any]

BINS = 10
"""Bins of equal width of the expected calibration error."""

MODEL_COMPONENTS = ("model", "dynamics", "process_noise", "covariance", "weights", "particles", "resampling", "fusion")
"""First words of the causes in a filter; others are in its data."""

RESAMPLES = 2000
Z = 1.959964
"""0.975 quantile of the normal distribution."""


@dataclass(frozen=True)
class Score:
    """A share of ``count`` cases with its 95 % interval, and the value that the project requires; NaN without cases."""

    name: str
    value: float
    low: float
    high: float
    count: int
    required: str

    def to_json(self) -> dict[str, Any]:
        numbers = {"value": self.value, "low": self.low, "high": self.high}
        rounded = {name: None if math.isnan(value) else round(value, 4) for name, value in numbers.items()}
        return {"name": self.name, **rounded, "count": self.count, "required": self.required}


def component(cause: str) -> str:
    """Name of a cause without its mechanism: ``model.image`` of ``model.image.bias``."""
    return cause.rpartition(".")[0]


def score_card(truths: Sequence[Truth], answers: Sequence[Answer]) -> list[Score]:
    """All scores. Accuracy counts visible single faults; a single fault is masked if it is not visible.

    - exact cause first, component first, exact cause in the first three: of visible single faults. The first also by
      the place of the fault: in data (sensors, controls, labels, physics) or in the model.
    - precision: the first cause was planted, of all answers ``fault``.
    - false alarms on clean controls: controls that were not answered ``healthy``.
    - calibration: expected calibration error of the first cause's probability, of all answers that name a cause.
    - masked recognised: masked single faults answered with ``masked``.
    - pairs: visible pairs with both causes in the first three.
    """
    planted = [[p["cause"] for p in truth["planted"]] for truth in truths]
    visible = [bool(truth["visible"]) for truth in truths]
    ranked = [causes_of(answer) for answer in answers]
    names = [[cause for cause, _ in causes] for causes in ranked]
    index = range(len(truths))
    singles = [i for i in index if len(planted[i]) == 1 and visible[i]]
    masked = [i for i in index if len(planted[i]) == 1 and not visible[i]]
    pairs = [i for i in index if len(planted[i]) == 2 and visible[i]]
    clean = [i for i in index if not planted[i]]
    accusing = [i for i in index if answers[i]["state"] == "fault" and names[i]]

    def share(name: str, required: str, cases: Sequence[int], correct: Callable[[int], bool]) -> Score:
        return proportion(name, [correct(i) for i in cases], required)

    in_model = {i for i in singles if planted[i][0].split(".")[0] in MODEL_COMPONENTS}
    in_data = [i for i in singles if i not in in_model]
    components = [[component(cause) for cause in causes] for causes in names]
    return [
        share("exact cause first", ">= 0.80", singles, lambda i: names[i][:1] == planted[i]),
        share("exact cause first, data", "", in_data, lambda i: names[i][:1] == planted[i]),
        share("exact cause first, model", "", sorted(in_model), lambda i: names[i][:1] == planted[i]),
        share("component first", ">= 0.92", singles, lambda i: components[i][:1] == [component(planted[i][0])]),
        share("exact cause in first three", ">= 0.95", singles, lambda i: planted[i][0] in names[i][:3]),
        share("precision", "", accusing, lambda i: names[i][0] in planted[i]),
        share("false alarms on clean controls", "<= 0.05", clean, lambda i: answers[i]["state"] != "healthy"),
        calibration([(causes[0][1], causes[0][0] in planted[i]) for i, causes in enumerate(ranked) if causes]),
        share("masked recognised", ">= 0.80", masked, lambda i: bool(answers[i].get("masked"))),
        share("pairs with both in first three", ">= 0.70", pairs, lambda i: set(planted[i]) <= set(names[i][:3])),
    ]


def causes_of(answer: Answer) -> list[tuple[str, float]]:
    """Named causes and their probabilities in the order of the answer; none if it is ``healthy``."""
    if answer["state"] == "healthy":
        return []
    return [(str(cause["cause"]), float(cause.get("probability", 1.0))) for cause in answer["causes"]]


def proportion(name: str, correct: Sequence[bool], required: str) -> Score:
    """Share of true values with Wilson's interval."""
    n = len(correct)
    if not n:
        return Score(name, math.nan, math.nan, math.nan, 0, required)
    p = sum(correct) / n
    centre = (p + Z**2 / (2 * n)) / (1 + Z**2 / n)
    half = Z / (1 + Z**2 / n) * math.sqrt(p * (1 - p) / n + Z**2 / (4 * n**2))
    return Score(name, p, max(0.0, centre - half), min(1.0, centre + half), n, required)


def calibration(pairs: Sequence[tuple[float, bool]]) -> Score:
    """Expected calibration error of (probability, correct), with a percentile bootstrap interval over cases."""
    name, required, n = "expected calibration error", "<= 0.07", len(pairs)
    if not n:
        return Score(name, math.nan, math.nan, math.nan, 0, required)
    values = np.array(pairs, dtype=float)
    draws = np.random.default_rng(0).integers(n, size=(RESAMPLES, n))
    low, high = np.percentile([calibration_error(values[draw]) for draw in draws], [2.5, 97.5])
    return Score(name, calibration_error(values), float(low), float(high), n, required)


def calibration_error(values: np.ndarray) -> float:
    """``sum_b n_b / n |mean probability - share of correct|`` over bins of the probability; values (n, 2)."""
    bins = np.minimum((values[:, 0] * BINS).astype(int), BINS - 1)
    excess = np.bincount(bins, weights=values[:, 0] - values[:, 1], minlength=BINS)
    return float(np.abs(excess).sum() / len(values))


def confusion(truths: Sequence[Truth], answers: Sequence[Answer]) -> dict[str, dict[str, int]]:
    """Planted cause of visible single faults -> first named cause -> number of cases."""
    counts: dict[str, dict[str, int]] = {}
    for truth, answer in zip(truths, answers, strict=True):
        if len(truth["planted"]) == 1 and truth["visible"]:
            first = next((cause for cause, _ in causes_of(answer)), answer["state"])
            row = counts.setdefault(truth["planted"][0]["cause"], {})
            row[first] = row.get(first, 0) + 1
    return counts


def table(scores: Mapping[str, Sequence[Score]]) -> str:
    """Markdown: one row per score, one column per tool."""
    rows = ["| score | required | " + " | ".join(scores) + " |", "| --- | --- |" + " --- |" * len(scores)]
    for line in zip(*scores.values(), strict=True):
        cells = ["" if not s.count else f"{s.value:.2f} [{s.low:.2f}, {s.high:.2f}] ({s.count})" for s in line]
        rows.append(f"| {line[0].name} | {line[0].required} | " + " | ".join(cells) + " |")
    return "\n".join(rows)

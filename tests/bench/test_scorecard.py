"""Scores of hand-made answers in closed form."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from beliefbench.scorecard import Score, calibration_error, confusion, proportion, score_card, table


def truth(*causes: str, visible: bool = True) -> dict[str, Any]:
    return {"planted": [{"cause": cause} for cause in causes], "visible": visible}


def answer(*causes: str, probability: float = 1.0, masked: bool = False) -> dict[str, Any]:
    rows = [{"cause": cause, "component": "", "probability": probability} for cause in causes]
    return {"state": "fault" if causes else "healthy", "masked": masked, "causes": rows}


TRUTHS = [
    truth("image.frozen"),
    truth("model.image.bias"),
    truth("dynamics.frozen"),
    truth("force.bias"),
    truth("force.noise", visible=False),
    truth("image.shift", visible=False),
    truth(visible=False),
    truth(visible=False),
    truth("image.shift", "dynamics.bias"),
]


def scores(answers: list[dict[str, Any]]) -> dict[str, Score]:
    return {score.name: score for score in score_card(TRUTHS, answers)}


def perfect(number: int) -> dict[str, Any]:
    planted = [p["cause"] for p in TRUTHS[number]["planted"]]
    return answer(*planted, masked=len(planted) == 1 and not TRUTHS[number]["visible"])


def test_perfect_tool() -> None:
    result = scores([perfect(i) for i in range(len(TRUTHS))])
    for name, score in result.items():
        assert score.value == (
            0.0 if name in ("false alarms on clean controls", "expected calibration error") else 1.0
        ), name
    counts = {name: score.count for name, score in result.items()}
    assert counts["exact cause first"] == 4
    assert counts["exact cause first, data"] == counts["exact cause first, model"] == 2
    assert counts["precision"] == 7
    assert counts["masked recognised"] == counts["false alarms on clean controls"] == 2
    assert counts["pairs with both in first three"] == 1


def test_silent_tool() -> None:
    result = scores([answer()] * len(TRUTHS))
    for name in ("exact cause first", "component first", "exact cause in first three", "masked recognised"):
        assert result[name].value == 0.0
    assert result["false alarms on clean controls"].value == 0.0
    assert result["precision"].count == result["expected calibration error"].count == 0
    assert math.isnan(result["precision"].value)


def test_tool_with_a_constant_answer() -> None:
    """Always ``image.shift`` with probability 0.7: right for two of nine cases, one of them a pair and one masked."""
    result = scores([answer("image.shift", probability=0.7)] * len(TRUTHS))
    assert result["exact cause first"].value == 0.0
    assert result["component first"].value == 0.25  # image.frozen
    assert result["false alarms on clean controls"].value == 1.0
    assert result["precision"].value == pytest.approx(2 / 9)
    assert result["expected calibration error"].value == pytest.approx(0.7 - 2 / 9)
    assert result["pairs with both in first three"].value == 0.0


def test_ranks_follow_the_order_of_the_answer() -> None:
    second = [answer("covariance.small", *(p["cause"] for p in t["planted"])) for t in TRUTHS]
    result = scores(second)
    assert result["exact cause first"].value == 0.0
    assert result["exact cause in first three"].value == 1.0
    assert result["pairs with both in first three"].value == 1.0
    fourth = [answer("a.x", "a.y", "a.z", *(p["cause"] for p in t["planted"])) for t in TRUTHS]
    assert scores(fourth)["exact cause in first three"].value == 0.0


def test_unsure_accuses_a_clean_filter() -> None:
    unsure = answer("image.shift") | {"state": "unsure"}
    result = scores([unsure] * len(TRUTHS))
    assert result["false alarms on clean controls"].value == 1.0
    assert result["precision"].count == 0


def test_calibration_error() -> None:
    """Two bins: 0.85 with three of four correct, 0.35 with none of one correct."""
    values = np.array([[0.85, 1], [0.85, 1], [0.85, 1], [0.85, 0], [0.35, 0]])
    assert calibration_error(values) == pytest.approx(4 / 5 * 0.1 + 1 / 5 * 0.35)
    calibrated = np.repeat([[0.25, 1], [0.25, 0]], [1, 3], axis=0)
    assert calibration_error(calibrated) == pytest.approx(0.0)


def test_intervals_contain_the_value_and_shrink() -> None:
    widths = []
    for n in (10, 100, 1000):
        score = proportion("", [True] * (n // 2) + [False] * (n // 2), "")
        assert 0 < score.low < 0.5 < score.high < 1
        widths.append(score.high - score.low)
    assert widths == sorted(widths, reverse=True)
    assert proportion("", [True] * 10, "").low == pytest.approx(10 / (10 + 1.959964**2))


def test_confusion_and_table() -> None:
    answers = [perfect(i) for i in range(len(TRUTHS))]
    answers[0] = answer()
    assert confusion(TRUTHS, answers)["image.frozen"] == {"healthy": 1}
    assert confusion(TRUTHS, answers)["force.bias"] == {"force.bias": 1}
    text = table({"mine": score_card(TRUTHS, answers)})
    assert "| exact cause first | >= 0.80 | 0.75 [0.30, 0.95] (4) |" in text

"""Success criteria: their text, and verdicts by intervals."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.filters.finetuning.success import Criterion
from beliefscope.inspect.compare.effects import Difference
from beliefscope.inspect.compare.success import Success, judge

PUSH = find_task("push")
MODELS = ("image", "haptics")


def test_text_and_settings_are_inverses() -> None:
    for text in ("contact:by=10%:others=5%", "force_bias x 5:measure=nees:by=2.5%:others=0%"):
        assert str(Criterion.parse(text)) == text
        settings = FineTune(success=Criterion.parse(text))
        assert FineTune.from_json(settings.to_json()) == settings
    assert Criterion.parse("contact") == Criterion("contact", by=0.1, others=0.05)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("contact:by=ten", "by=ten"),
        ("contact:by=0%", "by=0%"),
        ("contact:others=-1%", "others=-1%"),
        ("contact:better=1%", "better=1%"),
        (":by=10%", "no slice"),
        ("outside", "outside"),
        ("contact:measure=angle", "angle"),
    ],
)
def test_invalid_criterion_is_named(text: str, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        Criterion.parse(text).check(PUSH, MODELS, [])


def test_slice_must_be_evaluated() -> None:
    criterion, bias = Criterion("bias"), Slice("bias")
    with pytest.raises(BadInput, match="bias"):
        criterion.check(PUSH, MODELS, [])
    criterion.check(PUSH, MODELS, [bias])
    occluded = Criterion("image occluded")
    assert [s.name for s in occluded.slices(PUSH, MODELS, [bias])] == ["bias", "image occluded"]


def success_of(*effects: tuple[str, float, float, float]) -> Success:
    """Outcome by changes (slice, effect, low, high)."""
    name = PUSH.main_error.name
    rows = tuple(
        Difference(slice_, name, "cm", 100.0, 0.02, 0.01, *values, (0.0, 0.0, 0.0)) for slice_, *values in effects
    )
    comparison: Any = SimpleNamespace(differences=rows)
    return judge(Criterion("contact"), comparison, PUSH)


def verdict(*effects: tuple[str, float, float, float]) -> tuple[str, str]:
    """Outcome and verdict of changes (slice, effect, low, high)."""
    success = success_of(*effects)
    return success.outcome, success.verdict


def test_outcome_follows_from_the_intervals() -> None:
    good, nan = ("contact", -0.3, -0.4, -0.2), float("nan")
    assert verdict(good, ("clean", 0.02, -0.1, 0.2))[0] == "met"
    assert verdict(("contact", -0.3, -0.5, -0.1), ("clean", 0.0, 0.0, 0.0))[0] == "inconclusive"
    assert verdict(("contact", -0.05, -0.09, -0.01), ("clean", 0.0, 0.0, 0.0))[0] == "not met"
    assert verdict(good, ("clean", 0.08, 0.01, 0.15))[0] == "inconclusive"
    outcome, text = verdict(good, ("free motion", 0.0, 0.0, 0.0), ("clean", 0.1, 0.06, 0.15))
    assert outcome == "not met"
    assert "beyond the limit: clean +10.5 %" in text
    noise, blackout = ("image_noise", 0.2, -0.1, 0.5), ("image_blackout", 0.3, 0.02, 0.6)
    text = verdict(good, noise, ("clean", 0.1, 0.06, 0.15), blackout)[1]
    assert "beyond the limit: clean +10.5 %" in text
    assert text.endswith("; inconclusive in 2 more slices.")
    text = verdict(good, noise, blackout)[1]
    assert "; inconclusive in 2 slices, most in image blackout +35.0 %" in text
    assert "beyond" not in text
    assert verdict(("contact", -0.3, nan, nan))[0] == "inconclusive"
    text = verdict(good, ("image_noise", 0.08, 0.01, 0.15))[1]
    assert "image noise +8.3 %" in text
    assert "too few to decide image noise" in text
    assert verdict(("clean", -0.3, -0.4, -0.2))[0] == "inconclusive"


def test_regressions_that_are_not_excluded_are_named() -> None:
    good, clean = ("contact", -0.3, -0.4, -0.2), ("clean", 0.0, -0.01, 0.01)
    success = success_of(good, clean, ("haptics only", 0.037, -0.03, 0.11), ("image_noise", 0.01, -0.1, 0.06))
    assert success.outcome == "met"
    assert success.not_excluded == ("haptics only", "image_noise")
    assert success.verdict.startswith("Met; +5 % not excluded in haptics only, image noise: contact -25.9 %")
    assert success_of(good, clean).verdict.startswith("Met: contact")
    assert success_of(good, ("clean", 0.08, 0.01, 0.15)).not_excluded == ()  # of an inconclusive criterion

"""Weaknesses that fine-tuning can address."""

from dataclasses import replace

import pytest

from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnosis.weaknesses import diagnosed, untrained

EVIDENCE = [{"text": "the image is frozen", "episode": 9, "step": 40}]


def test_a_fault_that_a_filter_was_fine_tuned_on_is_not_offered_again() -> None:
    checkpoint = load_checkpoint(pretrained_path("push-field", "information-ekf"))
    (weakness,) = untrained(checkpoint)
    settings = weakness.settings.to_json()
    assert [item["slice"]["faults"][0]["fault"] for item in settings["mix"]] == ["image_noise"]
    assert not list(untrained(replace(checkpoint, record={"base": {"settings": settings}})))


@pytest.mark.parametrize(
    ("measure", "share", "expected", "effect"),
    [
        ("angle", 0.3, "angle", "; undoing it removes 30 % of the angle error"),
        ("position", 0.3, "error", "; undoing it removes 30 % of the position error"),
        ("angle", 0.004, "error", ""),
        ("angle", -0.2, "error", ""),
    ],
)
def test_the_criterion_is_about_the_error_that_the_cause_increases(
    measure: str, share: float, expected: str, effect: str
) -> None:
    """A frozen image of a door increases the error of the angle, hardly that of the hinge."""
    filter_ = load_checkpoint(pretrained_path("door", "crossmodal-ekf")).filter
    recovered = {"error": share, "low": None, "high": None, "nll": 4.6, "measure": measure}
    cause = {"cause": "image.frozen", "title": "", "probability": 1.0, "evidence": EVIDENCE, "recovered": recovered}
    (weakness,) = diagnosed({"causes": [cause], "headline": ""}, filter_, Faults.parse("image_frozen=40"), 9)
    assert weakness.settings.success is not None
    assert weakness.settings.success.measure == expected
    assert weakness.evidence == f"Probability above 0.99: the image is frozen{effect}."


@pytest.mark.parametrize(
    ("cause", "presets"),
    [
        ("model.haptics.bias", ["haptics-only"]),
        ("process_noise.small", ["noise-only"]),
        ("weights.constant", ["weights-only"]),
        ("weights.ignores_likelihood", []),  # its next action is a correction of the code
        ("data.shift", ["reliability-only"]),
    ],
)
def test_the_trained_modules_are_those_of_the_command_of_the_cause(cause: str, presets: list[str]) -> None:
    filter_ = load_checkpoint(pretrained_path("push", "crossmodal-pf")).filter
    entry = {"cause": cause, "title": "", "probability": 1.0, "evidence": EVIDENCE, "recovered": None}
    weaknesses = diagnosed({"causes": [entry], "headline": ""}, filter_, Faults(), 9)
    assert [preset for weakness in weaknesses for preset in weakness.settings.train] == presets

"""Calibration of the noise: NEES becomes 1, and the estimates stay."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.finetuning.finetune import finetune
from beliefscope.filters.finetuning.noise_scale import calibrate_noise, noise_parameters
from beliefscope.filters.finetuning.settings import FineTune

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def episodes(short_episodes: Callable[..., list[Episode]]) -> list[Episode]:
    return short_episodes("push", range(10), 60)


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["image-ekf", "crossmodal-ekf"])
def test_calibrated_nees_is_1_and_estimates_stay(episodes: list[Episode], name: str) -> None:
    filter_ = copy.deepcopy(load_checkpoint(pretrained_path("push", name)).filter)
    with torch.no_grad():
        for parameter in noise_parameters(filter_):
            parameter -= 0.7  # overconfident by a factor of 2 in the standard deviations
    before = evaluate(filter_, episodes)
    factor = calibrate_noise(filter_, lambda: evaluate(filter_, episodes).nees)
    after = evaluate(filter_, episodes)
    assert before.nees > 1.5
    assert factor == pytest.approx(before.nees**0.5, rel=0.05)
    assert after.nees == pytest.approx(1.0, abs=0.02)
    # The fixed covariance of the first belief has lost its influence after the 30 steps that are not counted.
    assert after.rmse["position_cm"] == pytest.approx(before.rmse["position_cm"], rel=0.05)


@pytest.mark.long
def test_fine_tuning_calibrates_on_validation_episodes(episodes: list[Episode]) -> None:
    base = load_checkpoint(pretrained_path("push", "crossmodal-ekf"))
    settings = FineTune(train=("noise-only",), length=6, windows=4, steps=2, check=2, calibrate=True)
    tuned = finetune(base, episodes, data_hash="-", settings=settings)
    assert tuned is not None
    assert tuned.record["noise_factor"] != 1.0
    assert FineTune.from_json(tuned.record["base"]["settings"]) == settings


@pytest.mark.parametrize(
    ("name", "train", "message"),
    [
        ("crossmodal-pf", "noise-only", "--calibrate applies to ekf and ukf filters, not to pf"),
        ("crossmodal-ekf", "weights-only", "add noise-only to --train"),
    ],
)
def test_calibration_that_cannot_be_done_is_refused(
    episodes: list[Episode], name: str, train: str, message: str
) -> None:
    base = load_checkpoint(pretrained_path("push", name))
    with pytest.raises(BadInput, match=message):
        finetune(base, episodes, data_hash="-", settings=FineTune(train=(train,), calibrate=True))

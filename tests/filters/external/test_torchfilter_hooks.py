"""The sensors of a single model are not guessed."""

from __future__ import annotations

import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.external.adapter import model_names


def test_a_single_model_is_not_named_after_a_sensor() -> None:
    values = {"modality_mean": torch.zeros(4, 1, 3)}
    assert model_names(values, 1, (), find_task("door")) == ("model-1",)
    assert model_names(values, 1, ("radar",), find_task("door")) == ("radar",)
    values = {"modality_mean": torch.zeros(4, 2, 3)}
    assert model_names(values, 1, (), find_task("door")) == ("image", "haptics")

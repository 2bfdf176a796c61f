"""Rows matched by sorting equal those of the pairwise comparison; a single model's sensors are not guessed."""

from __future__ import annotations

import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.external.adapter import model_names
from beliefscope.filters.external.hooks import _first_equal


def test_ancestors_equal_those_of_all_pairs() -> None:
    generator = torch.Generator().manual_seed(0)
    before = torch.randn(3, 50, 2, generator=generator)
    before[:, 7] = before[:, 3]  # the first of equal rows
    index = torch.randint(50, (3, 40), generator=generator)
    after = before.gather(1, index.unsqueeze(-1).expand(-1, -1, 2))
    pairs = (after.unsqueeze(2) == before.unsqueeze(1)).all(-1)
    assert torch.equal(_first_equal(after, before), pairs.int().argmax(-1))
    after[1, 5] = 9.0
    assert (_first_equal(after, before) == 50).nonzero().tolist() == [[1, 5]]


def test_a_single_model_is_not_named_after_a_sensor() -> None:
    values = {"modality_mean": torch.zeros(4, 1, 3)}
    assert model_names(values, 1, (), find_task("door")) == ("model-1",)
    assert model_names(values, 1, ("radar",), find_task("door")) == ("radar",)
    values = {"modality_mean": torch.zeros(4, 2, 3)}
    assert model_names(values, 1, (), find_task("door")) == ("image", "haptics")

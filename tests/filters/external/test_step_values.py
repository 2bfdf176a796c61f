"""Values of steps are copied once, into arrays; ancestors are those of all pairs of particles."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.external import derived_values
from beliefscope.filters.external.ancestors import ancestors as search, new_table, words_of
from beliefscope.filters.external.step_values import BLOCK, StepValues, with_ancestors
from beliefscope.filters.external.torchfilter_hooks import RESAMPLED


def ancestors(after: Tensor, before: Tensor) -> Tensor:
    return search(words_of(after), words_of(before))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
def test_ancestors_equal_those_of_all_pairs(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    before = torch.randn(3, 50, 2, generator=generator).to(dtype)
    before[:, 7] = before[:, 3]  # the first of equal rows
    before[:, 9] = 0.0
    index = torch.randint(50, (3, 40), generator=generator)
    index[:, 0] = 9
    after = before.gather(1, index.unsqueeze(-1).expand(-1, -1, 2))
    pairs = (after.unsqueeze(2) == before.unsqueeze(1)).all(-1)
    assert torch.equal(ancestors(-after, -before), pairs.int().argmax(-1).int())
    after[:, 0] = -0.0
    assert (ancestors(after, before)[:, 0] == 9).all()
    after[1, 5] = 9.0
    assert (ancestors(after, before) == 50).nonzero().tolist() == [[1, 5]]


@pytest.mark.parametrize("distinct", [1, 2, 5000])
def test_ancestors_of_many_particles_with_equal_rows(distinct: int) -> None:
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(distinct, 3, generator=generator)
    rows = torch.randint(distinct, (20_000,), generator=generator)
    wanted = torch.randint(distinct, (20_000,), generator=generator)
    first = torch.full((distinct,), 20_000).scatter_reduce_(0, rows, torch.arange(20_000), "amin")
    assert torch.equal(ancestors(values[wanted][None], values[rows][None])[0], first[wanted].int())


def test_rows_with_equal_hashes_are_compared() -> None:
    """Words that are multiples of 2^30 have four hashes in all, so that rows are found by comparison."""
    generator = torch.Generator().manual_seed(2)
    values = torch.tensor([0.0, 2.0, -2.0])  # 2.0 is 2^30 as a word, and -2.0 is 3 x 2^30
    before = values[torch.randint(3, (300, 6), generator=generator)]
    wanted = torch.randint(300, (200,), generator=generator)
    pairs = (before[wanted][:, None] == before[None]).all(-1)
    assert torch.equal(ancestors(before[wanted][None], before[None])[0], pairs.int().argmax(-1).int())
    assert (ancestors(torch.full((1, 4, 6), 7.0), before[None]) == 300).all()
    before[:, 0] = 0.0
    assert (ancestors(torch.full((1, 4, 6), 2.0), before[None]) == 300).all()


def test_a_table_may_have_entries_of_an_earlier_search() -> None:
    generator = torch.Generator().manual_seed(3)
    table = new_table(500)
    for _ in range(4):
        before = words_of(torch.randn(1, 500, 3, generator=generator))
        index = torch.randint(500, (500,), generator=generator)
        after = np.ascontiguousarray(before[:, :, index.numpy()])
        assert torch.equal(search(after, before, table)[0], index.int())
        assert (search(after + np.uint32(1), before, table) == 500).all()


def test_diverged_particles_have_ancestors() -> None:
    nan = torch.full((1, 3000, 2), torch.nan)
    assert (ancestors(nan, nan) == 0).all()  # and the search ends


def recorded(steps: list[dict[str, Tensor]]) -> tuple[StepValues, dict[str, Tensor]]:
    record = StepValues(len(steps))
    for step in steps:
        record.append(step)
    return record, record.stacked()


def test_values_that_a_filter_modifies_in_place_are_copied() -> None:
    mean, record = torch.zeros(1, 2), StepValues(3)
    for _ in range(3):
        mean += 1.0
        record.append({"estimate_mean": mean})
    assert record.stacked()["estimate_mean"][:, 0, 0].tolist() == [1.0, 2.0, 3.0]


def test_values_of_some_steps_are_left_out() -> None:
    mean, extra = torch.zeros(1, 2), torch.ones(1)
    first, last = {"estimate_mean": mean, "extra/a": extra}, {"estimate_mean": mean, "extra/b": extra}
    assert set(recorded([first, last])[1]) == {"estimate_mean"}


def test_measurements_of_other_sizes_are_extended() -> None:
    steps = [{"estimate_mean": torch.zeros(1, 2), "innovation": torch.ones(1, 1, m)} for m in (1, 3, 2, 2)]
    record, values = recorded(steps)
    assert values["innovation"].isnan().sum((1, 2, 3)).tolist() == [2, 0, 1, 1]
    assert [step["innovation"].shape[-1] for step in record.steps] == [1, 3, 2, 2]
    with pytest.raises(RuntimeError):
        recorded([{"estimate_mean": torch.zeros(1, n)} for n in (2, 3)])


def test_ancestors_are_searched_in_blocks() -> None:
    generator = torch.Generator().manual_seed(0)
    steps = []
    for _ in range(2 * BLOCK + 3):
        particles = torch.randn(1, 20, 2, generator=generator)
        index = torch.randint(20, (20,), generator=generator)
        steps.append({"particles": particles, RESAMPLED: particles[:, index], "index": index[None].int()})
    values = recorded(steps)[1]
    assert torch.equal(values["ancestors"], values["index"])
    assert RESAMPLED not in values
    steps[5][RESAMPLED] = steps[5][RESAMPLED] + 1.0  # moved after resampling
    assert "ancestors" not in recorded(steps)[1]
    assert torch.equal(with_ancestors(steps[3])["ancestors"], steps[3]["index"])
    assert set(with_ancestors(steps[5])) == {"particles", "index"}


def test_moments_of_blocks_are_those_of_all_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    prior, likelihood = (torch.randn(7, 2, 30, generator=generator) for _ in range(2))
    values = {
        "estimate_mean": torch.zeros(7, 2, 3),
        "particles": torch.randn(7, 2, 30, 3, generator=generator),
        "prior_log_weights": prior,
        "log_weights": prior + likelihood,
        "log_likelihood": likelihood.unsqueeze(2),
    }
    results = []
    for block in (1, 400, 10**6):  # 1, 2 and all steps
        monkeypatch.setattr(derived_values, "BLOCK", block)
        results.append(derived_values.derived({k: v.clone() for k, v in values.items()}, find_task("door")))
    for name, value in results[0].items():
        # The order of sums over particles does not depend on the number of steps.
        assert torch.equal(value, results[1][name]), name
        assert torch.equal(value, results[2][name]), name
    weights = torch.softmax(values["log_weights"], -1)
    mean = (weights.unsqueeze(-1) * values["particles"]).sum(2)
    torch.testing.assert_close(results[0]["modality_mean"][:, :, 0], mean)


def test_moments_of_angles_do_not_depend_on_where_they_wrap() -> None:
    generator = torch.Generator().manual_seed(2)
    task = find_task("door")  # the third component is an angle
    likelihood = torch.randn(5, 1, 2, 200, generator=generator)
    values = {
        "estimate_mean": torch.zeros(5, 1, 3),
        "particles": 0.1 * torch.randn(5, 1, 200, 3, generator=generator),
        "prior_log_weights": torch.zeros(5, 1, 200),
        "log_weights": likelihood.sum(2),
        "log_likelihood": likelihood,
    }
    turned = {name: value.clone() for name, value in values.items()}
    angle = turned["particles"][..., 2] + torch.pi
    turned["particles"][..., 2] = (angle + torch.pi) % (2.0 * torch.pi) - torch.pi
    assert (turned["particles"][..., 2].amax(2) - turned["particles"][..., 2].amin(2) > 6.0).all()
    expected, result = derived_values.derived(values, task), derived_values.derived(turned, task)
    for name in ("estimate_covariance", "modality_covariance"):
        torch.testing.assert_close(result[name], expected[name], atol=1e-6, rtol=1e-4)
    difference = task.difference(result["modality_mean"].numpy(), expected["modality_mean"].numpy())
    np.testing.assert_allclose(np.abs(difference), np.broadcast_to([0, 0, np.pi], difference.shape), atol=1e-5)

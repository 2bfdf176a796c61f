"""Common random numbers, and evidence of subsets of the models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence, Gaussian
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.common_random_numbers import Common, normal, uniform
from beliefscope.filters.rollout import first_belief, rollout

STEPS, PARTICLES = 6, 50
SUBSETS = torch.tensor([[False, False], [True, False], [False, True], [True, True]])

KINDS = ("crossmodal-ekf", "crossmodal-ukf", "unimodal-ekf", "crossmodal-pf", "unimodal-pf", "feature-pf")


@pytest.mark.parametrize("sample", [normal, uniform])
def test_common_numbers_equal_those_of_one_trajectory(sample: Callable[..., Tensor]) -> None:
    common, plain = Common().manual_seed(3), torch.Generator().manual_seed(3)
    for _ in range(2):
        numbers, single = sample((4, 5, 2), common), sample((1, 5, 2), plain)
        assert torch.equal(numbers, single.expand(4, -1, -1))
    assert torch.equal(common.get_state(), plain.get_state())
    independent = sample((4, 5, 2), plain)
    assert not torch.equal(independent[0], independent[1])


def setup(name: str, window: Callable[..., Batch]) -> tuple[Filter, Evidence, Gaussian]:
    """An untrained filter, one trajectory's evidence, and its first belief."""
    filter_ = build(architecture("door", name)).eval().requires_grad_(False)
    batch = window(STEPS, 1)
    return filter_, filter_.encode(batch), first_belief(filter_, batch)


def run(filter_: Filter, evidence: Evidence, start: Gaussian) -> Tensor:
    """Estimates (T, N, n)."""
    count = evidence.control.shape[1]
    belief = Gaussian(start.mean.expand(count, -1), start.covariance.expand(count, -1, -1))
    return rollout(filter_, evidence, belief, Common().manual_seed(0), PARTICLES).estimate.mean


def subsets(evidence: Evidence) -> Tensor:
    """(T, S, K): all subsets of the evidence's models."""
    count = evidence.observation.shape[2]
    return SUBSETS[: 2**count, :count].expand(len(evidence), -1, -1)


@pytest.mark.parametrize("name", KINDS)
def test_batched_subsets_equal_single_ones(name: str, window: Callable[..., Batch]) -> None:
    filter_, evidence, start = setup(name, window)
    present = subsets(evidence)
    batched = run(filter_, evidence.select_models(present), start)
    # The full set equals no selection, up to rounding, which depends on the batch size.
    torch.testing.assert_close(batched[:, -1:], run(filter_, evidence, start), rtol=0, atol=1e-5)
    for i in range(present.shape[1]):
        single = run(filter_, evidence.select_models(present[:, i : i + 1]), start)
        torch.testing.assert_close(batched[:, i : i + 1], single, rtol=0, atol=1e-5)
    if evidence.log_weights is not None:
        for k in range(2):
            only = run(filter_, evidence.only(k), start)
            torch.testing.assert_close(batched[:, 1 + k : 2 + k], only, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", KINDS)
def test_observations_of_absent_models_have_no_effect(name: str, window: Callable[..., Batch]) -> None:
    filter_, evidence, start = setup(name, window)
    other = replace(evidence, observation=evidence.observation + 1.0)
    present = subsets(evidence)
    runs = [run(filter_, e.select_models(present), start) for e in (evidence, other)]
    assert torch.equal(runs[0][:, 0], runs[1][:, 0])
    assert not torch.equal(runs[0][:, -1], runs[1][:, -1])


def test_kalman_filter_without_models_only_predicts(window: Callable[..., Batch]) -> None:
    filter_, evidence, start = setup("crossmodal-ekf", window)
    mean = start.mean
    for t, estimate in enumerate(run(filter_, evidence.select_models(subsets(evidence)), start)[:, 0]):
        mean = filter_.dynamics(mean, evidence.control[t])
        torch.testing.assert_close(estimate, mean[0], rtol=0, atol=1e-5)


def test_particle_weights_without_models_are_unchanged(window: Callable[..., Batch]) -> None:
    filter_, evidence, start = setup("crossmodal-pf", window)
    belief = filter_.start(start, PARTICLES, torch.Generator().manual_seed(0))
    none = evidence.select_models(subsets(evidence)[:, :1])
    _, step = filter_.step(belief, none[0], torch.Generator().manual_seed(0))
    log_weights = step.posterior.log_weights  # type: ignore[union-attr]
    torch.testing.assert_close(log_weights, belief.log_weights)  # type: ignore[union-attr]


def three(log_weights: Tensor) -> Evidence:
    """One step of three models with log beta (3, W) and zero observations."""
    zeros = torch.zeros(1, 1, 3, 1)
    return Evidence(torch.zeros(1, 1, 1), zeros, zeros, log_weights[None, None])


def test_beta_of_present_models_keeps_its_proportions() -> None:
    beta = torch.tensor([[0.5, 0.2], [0.3, 0.2], [0.2, 0.6]])
    selected = three(beta.log()).select_models(torch.tensor([[[True, False, True], [False, False, False]]]))
    assert selected.log_weights is not None
    assert selected.present is not None
    shares = torch.softmax(selected.log_weights[0], dim=-2)
    torch.testing.assert_close(shares[0], torch.tensor([[5 / 7, 0.25], [0.0, 0.0], [2 / 7, 0.75]]))
    torch.testing.assert_close(shares[1], beta)  # without any model: unchanged
    assert selected[0].present is not None
    assert torch.equal(selected[0].present, selected.present[0])
    assert selected[:1].control.shape == (1, 2, 1)


def test_beta_zero_is_not_present() -> None:
    beta = torch.tensor([[0.6], [0.4], [0.0]])
    present = torch.tensor([[[True, True, True], [False, False, True]]])
    selected = three(beta.log()).select_models(present)
    assert selected.present is not None
    assert selected.present[0].tolist() == [[True, True, False], [False, False, False]]
    assert selected.log_weights is not None
    torch.testing.assert_close(torch.softmax(selected.log_weights[0], dim=-2), beta.expand(2, 3, 1))

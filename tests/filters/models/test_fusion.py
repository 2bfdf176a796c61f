"""Fusion rules: Gaussians calculated by hand, one-hot weights and permutations."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from beliefscope.filters.belief import Gaussian
from beliefscope.filters.models.fusion import mixture, positive_definite, product_of_experts, weighted_average

torch.manual_seed(0)


def bank(n: int = 3, batch: int = 64, seed: int = 0) -> Gaussian:
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(batch, 2, n, n, generator=generator, dtype=torch.float64)
    covariance = root @ root.transpose(-1, -2) + 0.1 * torch.eye(n, dtype=torch.float64)
    return Gaussian(torch.randn(batch, 2, n, generator=generator, dtype=torch.float64), covariance)


def log_beta(shape: tuple[int, ...], seed: int = 1) -> Tensor:
    logits = torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.log_softmax(2.0 * logits, dim=1)


def test_product_of_two_experts_by_hand() -> None:
    # N(0, 1) times N(3, 2): precision 1 + 1/2, so variance 2/3 and mean (0 + 3/2) * 2/3 = 1.
    two = Gaussian(torch.tensor([[[0.0], [3.0]]]), torch.tensor([[[[1.0]], [[2.0]]]]))
    fused = product_of_experts(two)
    assert fused.mean.item() == pytest.approx(1.0)
    assert fused.covariance.item() == pytest.approx(2.0 / 3.0)


def test_weighted_average_by_hand() -> None:
    # beta 1/4 and 3/4 in one dimension: B is beta squared, so variances 1 and 2 have weights 1/16 and 9/16: 19/10.
    two = Gaussian(torch.tensor([[[0.0], [4.0]]]), torch.tensor([[[[1.0]], [[2.0]]]]))
    weights = torch.tensor([[[0.25], [0.75]]]).log()
    paper = weighted_average(two, weights, "paper")
    assert paper.mean.item() == pytest.approx(3.0)
    assert paper.covariance.item() == pytest.approx(1.9)
    # The mixture's variance: 1/4 (1 + 9) + 3/4 (2 + 1).
    assert weighted_average(two, weights, "moments").covariance.item() == pytest.approx(4.75)


@pytest.mark.parametrize("rule", ["paper", "moments"])
def test_weighted_average_is_definite_and_symmetric_in_the_modalities(rule: str) -> None:
    both, weights = bank(), log_beta((64, 2, 3))
    fused = weighted_average(both, weights, rule)  # type: ignore[arg-type]
    torch.testing.assert_close(fused.covariance, fused.covariance.transpose(-1, -2))
    assert torch.linalg.eigvalsh(fused.covariance).min() > 0
    swapped = weighted_average(
        Gaussian(both.mean.flip(1), both.covariance.flip(1)),
        weights.flip(1),
        rule,  # type: ignore[arg-type]
    )
    torch.testing.assert_close(swapped.mean, fused.mean)
    torch.testing.assert_close(swapped.covariance, fused.covariance)


@pytest.mark.parametrize("rule", ["paper", "moments"])
@pytest.mark.parametrize("k", [0, 1])
def test_one_hot_weights_give_the_unimodal_belief(rule: str, k: int) -> None:
    both = bank()
    weights = torch.full((64, 2, 3), -torch.inf, dtype=torch.float64)
    weights[:, k] = 0.0
    fused = weighted_average(both, weights, rule)  # type: ignore[arg-type]
    torch.testing.assert_close(fused.mean, both.mean[:, k])
    # The paper's ratio retains exp(-80) of the other modality.
    torch.testing.assert_close(fused.covariance, both.covariance[:, k], rtol=1e-12, atol=1e-12)


def test_opposite_one_hot_weights_per_component_give_a_definite_covariance() -> None:
    covariance = torch.tensor([[[[1.0, 0.99], [0.99, 1.0]], [[100.0, 99.0], [99.0, 100.0]]]])
    weights = torch.tensor([[[0.0, -torch.inf], [-torch.inf, 0.0]]])
    fused = weighted_average(Gaussian(torch.zeros(1, 2, 2), covariance), weights, "paper")
    # The off-diagonal entry must be below sqrt(1 * 100) = 10, but the literal formula gives about 50.
    assert torch.linalg.eigvalsh(fused.covariance).min() > 0
    torch.testing.assert_close(fused.covariance.diagonal(dim1=-2, dim2=-1), torch.tensor([[1.0, 100.0]]))


def test_definite_matrices_are_unchanged() -> None:
    covariance = bank().covariance
    assert positive_definite(covariance) is covariance


def test_mixture_is_the_log_of_the_weighted_sum() -> None:
    log_likelihood = torch.randn(4, 2, 10, dtype=torch.float64)
    weights = log_beta((4, 2, 1))
    expected = (weights.exp() * log_likelihood.exp()).sum(1).log()
    torch.testing.assert_close(mixture(log_likelihood, weights), expected)
    torch.testing.assert_close(mixture(log_likelihood, None), log_likelihood.exp().sum(1).log())
    torch.testing.assert_close(mixture(log_likelihood.flip(1), weights.flip(1)), expected)

"""Derivatives of networks, and resampling."""

from __future__ import annotations

import platform
import subprocess
import sys
import warnings

import pytest
import torch
from torch import nn

from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.filters.models.networks import Encoders, Residual, Stack, vector_stack
from beliefscope.filters.models.resampling import effective_sample_size, multinomial, resample, soft, systematic


def test_jacobian_agrees_with_finite_differences() -> None:
    torch.manual_seed(3)
    dynamics = Dynamics(n=3, control_size=7, units=16).double()
    # The initial output layer is almost zero: make the change large enough to test.
    torch.nn.init.normal_(dynamics.output.weight, std=1.0)
    states = torch.randn(5, 3, dtype=torch.float64)
    part = dynamics.control_part(torch.randn(5, 7, dtype=torch.float64))
    value, jacobian = dynamics.with_jacobian(states, part)
    torch.testing.assert_close(value, dynamics(states, part))
    step = 1e-6
    for i in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[i] = step
        column = (dynamics(states + shift, part) - dynamics(states - shift, part)) / (2 * step)
        # Error of central differences: step^2 plus rounding / step, about 1e-9, unless a ReLU kink is crossed.
        torch.testing.assert_close(jacobian[..., i], column, rtol=1e-6, atol=1e-8)


def test_gradients_flow_through_the_jacobian() -> None:
    torch.manual_seed(4)
    dynamics = Dynamics(n=3, control_size=7, units=16)
    torch.nn.init.normal_(dynamics.output.weight, std=1.0)
    _, jacobian = dynamics.with_jacobian(torch.randn(5, 3), dynamics.control_part(torch.randn(5, 7)))
    jacobian.square().sum().backward()
    for name in ("state_encoder.0.weight", "join_control.weight", "shared.1.first.weight", "output.weight"):
        gradient = dynamics.get_parameter(name).grad
        assert gradient is not None
        assert gradient.abs().sum() > 0, name


def test_systematic_resampling_counts_are_floor_or_ceil_of_the_expectation() -> None:
    generator = torch.Generator().manual_seed(5)
    log_weights = torch.log_softmax(2.0 * torch.randn(200, 50, generator=generator), dim=-1)
    ancestors = systematic(log_weights, generator)
    counts = torch.zeros(200, 50).scatter_add_(1, ancestors, torch.ones(200, 50))
    share = 50 * log_weights.exp()
    # Float32 sums of 50 weights are accurate to about 1e-5.
    assert bool((counts >= (share - 1e-4).floor()).all())
    assert bool((counts <= (share + 1e-4).ceil()).all())


def test_systematic_resampling_is_unbiased() -> None:
    generator = torch.Generator().manual_seed(6)
    log_weights = torch.log_softmax(torch.randn(1, 8, generator=generator), dim=-1).expand(20_000, 8)
    ancestors = systematic(log_weights, generator)
    mean_count = torch.stack([(ancestors == i).float().sum(-1).mean() for i in range(8)])
    # Counts deviate by less than 1, so the mean of 20,000 runs has an error of 1 / sqrt(20000) = 0.007; allow four.
    torch.testing.assert_close(mean_count, 8 * log_weights[0].exp(), rtol=0, atol=0.03)


def test_multinomial_resampling_has_binomial_counts() -> None:
    generator = torch.Generator().manual_seed(7)
    log_weights = torch.log_softmax(torch.randn(1, 8, generator=generator), dim=-1).expand(20_000, 8)
    counts = torch.nn.functional.one_hot(multinomial(log_weights, generator), 8).float().sum(1)
    share = log_weights[0].exp()
    # Binomial: mean 8 w and variance 8 w (1 - w); 20,000 runs determine the mean to 0.01, the variance to 1-2 %.
    torch.testing.assert_close(counts.mean(0), 8 * share, rtol=0, atol=0.05)
    torch.testing.assert_close(counts.var(0), 8 * share * (1 - share), rtol=0.1, atol=0.01)


def test_soft_resampling_is_unbiased() -> None:
    generator = torch.Generator().manual_seed(8)
    log_weights = torch.log_softmax(2.0 * torch.randn(1, 8, generator=generator), dim=-1).expand(20_000, 8)
    values = torch.randn(8, generator=generator)
    before = (log_weights[0].exp() * values).sum()
    ancestors, corrected = soft(log_weights, 0.5, generator)
    after = (corrected.exp() * values[ancestors]).sum(-1)
    # The error of one run is about 0.2, of the mean of 20,000 0.0015. Without weights it is much larger.
    assert (after.mean() - before).abs() < 0.006
    assert (values[ancestors].mean() - before).abs() > 0.05
    torch.testing.assert_close(corrected.exp().sum(-1).mean(), torch.tensor(1.0), rtol=0, atol=0.01)


def test_soft_resampling_corrects_by_importance_weights() -> None:
    # w = (0.9, 0.1): q = (0.7, 0.3) with share 0.5, so a copy weighs w / (2 q) = 9/14 or 1/6.
    log_weights = torch.tensor([[0.9, 0.1]]).log()
    ancestors, corrected = soft(log_weights, 0.5, torch.Generator().manual_seed(0))
    torch.testing.assert_close(corrected.exp(), torch.tensor([9 / 14, 1 / 6])[ancestors])
    # With share 1, particles are sampled from the weights, and all copies have equal weight.
    _, equal = soft(log_weights, 1.0, torch.Generator().manual_seed(0))
    torch.testing.assert_close(equal.exp(), torch.full((1, 2), 0.5))


def test_only_soft_resampling_has_gradients_and_all_weights_are_normalised() -> None:
    for rule in ("systematic", "hard", "soft"):
        logits = torch.randn(3, 10, requires_grad=True)
        _, weights = resample(torch.log_softmax(logits, dim=-1), rule, 0.5, torch.Generator().manual_seed(1))  # type: ignore[arg-type]
        torch.testing.assert_close(torch.logsumexp(weights, dim=-1), torch.zeros(3), rtol=0, atol=1e-6)
        assert weights.requires_grad == (rule == "soft")
    weights.square().sum().backward()
    assert logits.grad is not None
    assert logits.grad.abs().sum() > 0


def test_effective_sample_size_of_uniform_and_one_hot_weights() -> None:
    uniform = torch.log_softmax(torch.zeros(3, 40), dim=-1)
    one_hot = torch.full((1, 40), -torch.inf)
    one_hot[0, 7] = 0.0
    torch.testing.assert_close(effective_sample_size(uniform), torch.full((3,), 40.0))
    assert effective_sample_size(one_hot).item() == 1.0


def test_stacks_have_equal_outputs_with_and_without_gradients() -> None:
    """Without gradients, layers write over their inputs; the stack's own input must stay as it is."""
    torch.manual_seed(0)
    stack = Stack(nn.Linear(5, 16), nn.ReLU(inplace=True), Residual(16), Residual(16), nn.Linear(16, 2)).double()
    inputs = torch.randn(3, 4, 5, dtype=torch.float64)
    copy = inputs.clone()
    expected = stack(inputs)
    with torch.no_grad():
        torch.testing.assert_close(stack(inputs), expected.detach(), rtol=1e-12, atol=1e-12)  # sums in another order
    assert torch.equal(inputs, copy)
    assert expected.shape == (3, 4, 2)


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize("stride", [1, 2])
def test_encoded_images_have_the_same_bits_in_any_batch(stride: int) -> None:
    """Sweeps encode several episodes at once, traces one."""
    torch.manual_seed(0)
    encoder = Encoders({"image": (32, 32)}, 64, stride)
    images = torch.randn(100, 5, 32, 32)
    with torch.no_grad():
        together = encoder({"image": images})
        for count in (1, 2, 3):  # 100, 200 and 300 images are no multiples of a block
            assert torch.equal(encoder({"image": images[:, :count]}), together[:, :count])


def test_a_stack_without_inputs_has_the_initial_values_of_torch_and_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torch.manual_seed(5)
        values = vector_stack(0, 8).state_dict()
    torch.manual_seed(5)
    with pytest.warns(UserWarning, match="zero-element"):
        expected = Stack(nn.Linear(0, 8), nn.ReLU(), Residual(8)).state_dict()
    torch.testing.assert_close(values, expected, rtol=0.0, atol=0.0)


PAGES = """
import resource, torch
from beliefscope.filters.models.networks import ImageEncoder

def mapped() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

torch.set_num_threads(1)
encoder, images = ImageEncoder((32, 32), 64), torch.rand(64, 32, 32)
with torch.no_grad():
    encoder(images), encoder(images)
    before = mapped()
    for _ in range(5):
        encoder(images)
print((mapped() - before) / 5)
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the memory of other C libraries")
@pytest.mark.long
def test_encoder_of_a_new_process_uses_its_memory_again() -> None:
    output = subprocess.run([sys.executable, "-c", PAGES], check=True, capture_output=True, text=True, timeout=120)
    # Its feature maps have 1,200 pages of 4 KiB, all mapped again in every call without ``keep_freed_memory``.
    assert float(output.stdout) < 200

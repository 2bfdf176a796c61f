"""Derivatives by dual numbers, and resampling."""

from __future__ import annotations

import torch

from beliefscope.filters.dynamics import Dynamics
from beliefscope.filters.resample import effective_sample_size, systematic


def test_jacobian_agrees_with_finite_differences() -> None:
    torch.manual_seed(3)
    dynamics = Dynamics(n=3, control_size=7, units=16).double()
    # The fresh output layer is almost zero: make the change large enough to be seen.
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
        # Central differences err by step^2 and by rounding / step: about 1e-9 here, unless a ReLU kink is crossed.
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


def test_systematic_resampling_draws_each_particle_floor_or_ceil_of_its_share() -> None:
    generator = torch.Generator().manual_seed(5)
    log_weights = torch.log_softmax(2.0 * torch.randn(200, 50, generator=generator), dim=-1)
    ancestors = systematic(log_weights, generator)
    counts = torch.zeros(200, 50).scatter_add_(1, ancestors, torch.ones(200, 50))
    share = 50 * log_weights.exp()
    # Float32 sums of 50 weights are right to about 1e-5.
    assert bool((counts >= (share - 1e-4).floor()).all())
    assert bool((counts <= (share + 1e-4).ceil()).all())


def test_systematic_resampling_is_unbiased() -> None:
    generator = torch.Generator().manual_seed(6)
    log_weights = torch.log_softmax(torch.randn(1, 8, generator=generator), dim=-1).expand(20_000, 8)
    ancestors = systematic(log_weights, generator)
    mean_count = torch.stack([(ancestors == i).float().sum(-1).mean() for i in range(8)])
    # Counts differ from their mean by less than 1, so 20,000 runs give it to 1 / sqrt(20000) = 0.007; four of those.
    torch.testing.assert_close(mean_count, 8 * log_weights[0].exp(), rtol=0, atol=0.03)


def test_effective_sample_size_of_uniform_and_of_one() -> None:
    uniform = torch.log_softmax(torch.zeros(3, 40), dim=-1)
    one = torch.full((1, 40), -torch.inf)
    one[0, 7] = 0.0
    torch.testing.assert_close(effective_sample_size(uniform), torch.full((3,), 40.0))
    assert effective_sample_size(one).item() == 1.0

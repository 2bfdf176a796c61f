"""The transformer: recursion, causality and limited memory."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from beliefscope.filters.belief import Evidence, Gaussian
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.models.transformer import LAYERS, WINDOW, Transformer
from beliefscope.filters.rollout import rollout

STEPS, N = 150, 3
REACH = LAYERS * (WINDOW - 1)
"""Age of the oldest step that an estimate depends on."""


@pytest.fixture(scope="module")
def filter_() -> Transformer:
    built = build(architecture("door", "transformer"), seed=1).eval()
    assert isinstance(built, Transformer)
    return built


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    values = torch.randn(STEPS, N, 1, 64, generator=torch.Generator().manual_seed(2))
    return Evidence(control=values[:, :, 0], observation=values, noise=None, log_weights=None)


START = Gaussian(torch.tensor([[0.3, -0.2, 0.1]] * N), torch.eye(3).expand(N, 3, 3))


@torch.no_grad()
def estimates(filter_: Transformer, evidence: Evidence, start: Gaussian = START) -> torch.Tensor:
    return rollout(filter_, evidence, start, torch.Generator()).estimate.mean


@torch.no_grad()
def test_single_steps_equal_all_at_once(filter_: Transformer, evidence: Evidence) -> None:
    belief, single = filter_.start(START, 1, torch.Generator()), []
    for t in range(STEPS):
        belief, trace = filter_.step(belief, evidence[t], torch.Generator())
        single.append(trace.estimate.mean)
        assert trace.estimate.covariance.isnan().all()
    # Sums over 64 steps in another order: about ten roundings of values of order one.
    torch.testing.assert_close(torch.stack(single), estimates(filter_, evidence), atol=1e-5, rtol=0.0)


def test_estimates_depend_on_the_past_only_and_not_beyond_the_window(filter_: Transformer, evidence: Evidence) -> None:
    changed = 20
    other = evidence.observation.clone()
    other[changed] += 1.0
    moved = (estimates(filter_, replace(evidence, observation=other)) - estimates(filter_, evidence)).abs()
    moved = moved.amax(dim=(1, 2))
    assert (moved[:changed] == 0.0).all()
    assert (moved[changed : changed + WINDOW] > 0.0).all()
    assert (moved[changed + REACH + 1 :] < 1e-6).all()


def test_start_matters_until_it_leaves_the_memory(filter_: Transformer, evidence: Evidence) -> None:
    moved = (estimates(filter_, evidence, replace(START, mean=START.mean + 1.0)) - estimates(filter_, evidence)).abs()
    assert (moved[0] > 1e-4).any()
    assert (moved[REACH + 1 :] < 1e-6).all()


def test_a_window_does_not_depend_on_where_it_begins(filter_: Transformer, evidence: Evidence) -> None:
    """Continuing from a later belief gives the same estimates as the whole run."""
    with torch.no_grad():
        belief = filter_.start(START, 1, torch.Generator())
        for t in range(70):
            belief, _ = filter_.step(belief, evidence[t], torch.Generator())
        rest = torch.stack([s.estimate.mean for _, s in filter_.steps(belief, evidence[70:STEPS], torch.Generator())])
    torch.testing.assert_close(rest, estimates(filter_, evidence)[70:], atol=1e-5, rtol=0.0)

"""The equations of an EKF in NumPy agree with those in PyTorch, which are executed where gradients are needed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.filters.belief import Evidence, Gaussian
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.rollout import Rollout, rollout

DOUBLE = torch.float64  # so that tolerances can be tight
START = Gaussian(torch.zeros(1, 3, dtype=DOUBLE), 0.1 * torch.eye(3, dtype=DOUBLE).unsqueeze(0))


def filter_and_evidence(name: str, networks: str) -> tuple[ExtendedKalmanFilter, Evidence]:
    torch.manual_seed(5)
    filter_ = build(architecture("door", name, networks))  # type: ignore[arg-type]
    assert isinstance(filter_, ExtendedKalmanFilter)
    # The initial output layer is almost zero: make the change large enough to test.
    torch.nn.init.normal_(filter_.dynamics.output.weight, std=0.3)
    filter_.double()
    steps, k = 40, len(filter_.names)
    evidence = Evidence(
        control=filter_.dynamics.control_part(torch.randn(steps, 1, DOOR.control_size, dtype=DOUBLE)).detach(),
        observation=torch.randn(steps, 1, k, 3, dtype=DOUBLE),
        noise=torch.randn(steps, 1, k, 3, dtype=DOUBLE).exp(),
        log_weights=torch.log_softmax(torch.randn(steps, 1, k, 3, dtype=DOUBLE), dim=-2)
        if "crossmodal" in name
        else None,
    )
    return filter_, evidence


def run(filter_: Filter, evidence: Evidence) -> Rollout:
    return rollout(filter_, evidence, START, torch.Generator(), keep=True)


@pytest.mark.first(4)
@pytest.mark.parametrize("absent", [False, True])
@pytest.mark.parametrize("networks", ["default", "authors"])
@pytest.mark.parametrize("name", ["crossmodal-ekf", "unimodal-ekf", "image-ekf"])
def test_equals_pytorch(name: str, networks: str, absent: bool) -> None:
    filter_, evidence = filter_and_evidence(name, networks)
    if absent:
        evidence = evidence.select_models(torch.rand(evidence.observation.shape[:3]) < 0.6)
    reference = run(filter_, evidence)
    with torch.no_grad():
        result = run(filter_, evidence)
    assert reference.estimate.mean.requires_grad
    for expected, actual in zip(reference.steps, result.steps, strict=True):
        for field in ("predicted", "modality", "estimate"):
            a, b = getattr(expected, field), getattr(actual, field)
            torch.testing.assert_close(b.mean, a.mean, rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(b.covariance, a.covariance, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_a_step_has_the_same_bits_as_in_a_run() -> None:
    filter_, evidence = filter_and_evidence("crossmodal-ekf", "default")
    belief = filter_.start(START, 1, torch.Generator())
    for t, step in enumerate(run(filter_, evidence).steps):
        belief, trace = filter_.step(belief, evidence[t], torch.Generator())
        assert torch.equal(trace.estimate.mean, step.estimate.mean)
        assert torch.equal(trace.estimate.covariance, step.estimate.covariance)


@torch.no_grad()
def test_a_run_uses_the_current_weights() -> None:
    filter_, evidence = filter_and_evidence("crossmodal-ekf", "default")
    before = run(filter_, evidence).estimate.mean
    filter_.dynamics.output.bias.add_(0.5)
    assert filter_.single is None
    assert (run(filter_, evidence).estimate.mean - before).abs().max() > 1e-2


def test_evidence_by_step() -> None:
    _, evidence = filter_and_evidence("crossmodal-ekf", "default")
    evidence = replace(evidence, noise=None)
    steps = list(evidence)
    assert len(steps) == len(evidence)
    assert torch.equal(steps[3].observation, evidence[3].observation)
    assert steps[3].noise is None

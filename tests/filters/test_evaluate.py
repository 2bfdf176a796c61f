"""Metrics against what is known: errors drawn from the covariance that is claimed, and an estimator without one."""

from __future__ import annotations

import json
import math

import pytest
import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.evaluate import evaluate, metrics

DOOR = find_task("door")


def test_errors_drawn_from_their_covariance_are_consistent() -> None:
    generator = torch.Generator().manual_seed(0)
    root = torch.tensor([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [0.05, 0.0, 0.1]], dtype=torch.float64)
    error = torch.randn(40_000, 3, generator=generator, dtype=torch.float64) @ root.T
    covariance = root @ root.T
    found = metrics(DOOR, error, covariance.expand(len(error), 3, 3))
    assert found.nees == pytest.approx(1.0, abs=0.02)
    assert found.coverage95 == pytest.approx(0.95, abs=0.005)
    gaussian = torch.distributions.MultivariateNormal(torch.zeros(3, dtype=torch.float64), covariance)
    assert found.nll == pytest.approx(float(-gaussian.log_prob(error).mean()), abs=0.01)
    assert found.rmse["hinge_x_cm"] == pytest.approx(3.0, rel=0.02)
    assert found.rmse["angle_deg"] == pytest.approx(math.degrees(math.sqrt(0.05**2 + 0.1**2)), rel=0.02)
    assert found.rmse["position_cm"] == pytest.approx(100 * math.sqrt(0.03**2 + 0.01**2 + 0.02**2), rel=0.02)
    # Twice too sure of itself: four times the squared error for each unit of variance.
    assert metrics(DOOR, error, covariance.expand(len(error), 3, 3) / 4).nees == pytest.approx(4.0, abs=0.08)


def test_without_a_covariance_there_is_no_consistency() -> None:
    """An LSTM, on a door of the sample set: its errors count, and what speaks of a covariance is null, not zero."""
    with open_dataset(sample_path("door")) as dataset:
        episodes = [dataset[0]]
    filter_ = build(architecture("door", "lstm"))
    filter_.statistics.fit(Steps.of(DOOR, episodes))
    document = evaluate(filter_.eval(), episodes).to_dict()
    assert (document["nll"], document["nees"], document["coverage95"]) == (None, None, None)
    assert all(math.isfinite(value) and value > 0 for value in document["rmse"].values())
    json.dumps(document, allow_nan=False)

"""Metrics of errors drawn from a known covariance, and of an estimator without a covariance."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.evaluate import evaluate, metrics, nees_bounds

DOOR = find_task("door")


def test_errors_drawn_from_their_covariance_are_consistent() -> None:
    generator = torch.Generator().manual_seed(0)
    root = torch.tensor([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [0.05, 0.0, 0.1]], dtype=torch.float64)
    error = torch.randn(40_000, 3, generator=generator, dtype=torch.float64) @ root.T
    covariance = root @ root.T
    result = metrics(DOOR, error, covariance.expand(len(error), 3, 3))
    assert result.nees == pytest.approx(1.0, abs=0.02)
    assert result.coverage95 == pytest.approx(0.95, abs=0.005)
    gaussian = torch.distributions.MultivariateNormal(torch.zeros(3, dtype=torch.float64), covariance)
    assert result.nll == pytest.approx(float(-gaussian.log_prob(error).mean()), abs=0.01)
    assert result.rmse["hinge_x_cm"] == pytest.approx(3.0, rel=0.02)
    assert result.rmse["angle_deg"] == pytest.approx(math.degrees(math.sqrt(0.05**2 + 0.1**2)), rel=0.02)
    assert result.rmse["position_cm"] == pytest.approx(100 * math.sqrt(0.03**2 + 0.01**2 + 0.02**2), rel=0.02)
    # Half the standard deviation: four times the squared error relative to the variance.
    assert metrics(DOOR, error, covariance.expand(len(error), 3, 3) / 4).nees == pytest.approx(4.0, abs=0.08)


def test_consistency_is_null_without_a_covariance() -> None:
    with open_dataset(sample_path("door")) as dataset:
        episodes = [dataset[0]]
    filter_ = build(architecture("door", "lstm"))
    filter_.statistics.fit(Steps.from_episodes(DOOR, episodes))
    document = evaluate(filter_.eval(), episodes).to_dict()
    assert (document["nll"], document["nees"], document["coverage95"]) == (None, None, None)
    assert all(math.isfinite(value) and value > 0 for value in document["rmse"].values())
    json.dumps(document, allow_nan=False)


def test_nees_bounds_contain_95_percent_of_consistent_filters() -> None:
    low, high = nees_bounds(3, 14)
    errors = np.random.default_rng(0).standard_normal((20_000, 14, 3))
    nees = (errors**2).sum(-1).mean(-1) / 3
    assert np.mean((nees > low) & (nees < high)) == pytest.approx(0.95, abs=0.006)

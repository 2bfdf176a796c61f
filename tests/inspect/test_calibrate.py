"""Calibrations fitted to traces with known errors."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtri, ndtri

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.calibrate import calibrate
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

SIGMA = np.array([0.02, 0.03, 0.1])
FACTOR = 4.0
"""True variances over those of the filter."""


@pytest.fixture(scope="module")
def traces() -> list[Trace]:
    """Errors are Gaussian; the fused covariance is too small by ``FACTOR``, those of the modalities are correct."""
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        (first,) = trace_all(checkpoint, data, [0])
    rng, true = np.random.default_rng(0), np.diag(SIGMA**2).astype(np.float32)
    result = []
    for index in range(80):
        error = SIGMA * rng.standard_normal((len(first), 3, 3))
        states = first.episode.states
        result.append(
            replace(
                first,
                episode_index=index,
                estimate_mean=(states + error[:, 0]).astype(np.float32),
                estimate_covariance=np.broadcast_to(true / FACTOR, (len(first), 3, 3)),
                modality_mean=(states[:, None] + error[:, 1:]).astype(np.float32),
                modality_covariance=np.broadcast_to(true, (len(first), 2, 3, 3)),
            )
        )
    return result


def test_known_factor_is_recovered(traces: list[Trace]) -> None:
    report = calibrate(traces[:40], traces[40:], 0.9)
    layers = report.calibration.layers
    assert layers["fused"].scale == pytest.approx(FACTOR, rel=0.03)
    assert [layers[name].scale for name in traces[0].modalities] == pytest.approx([1.0, 1.0], rel=0.03)
    level = 0.9 * 41 / 40  # 40 episodes of 41 have this quantile
    assert layers["fused"].ellipsoid == pytest.approx(np.sqrt(FACTOR * chdtri(3, 1 - level)), rel=0.03)
    assert layers["fused"].distances["angle"] == pytest.approx(ndtri((1 + level) / 2) * SIGMA[2], rel=0.03)


def test_coverage_before_and_after(traces: list[Trace]) -> None:
    report = calibrate(traces[:40], traces[40:], 0.9)
    coverage = {(c.layer, c.phase, c.region): c for c in report.coverage}
    # P(chi-square_3 <= 6.2514 / FACTOR)
    assert coverage["fused", "all", "covariance"].share == pytest.approx(0.332, abs=0.03)
    expected = {"scaled covariance": 0.9} | dict.fromkeys(("ellipsoid", "position", "angle"), 0.9225)
    for (layer, _, region), c in coverage.items():
        assert c.low <= c.share <= c.high
        if layer == "fused" and region in expected:
            assert c.share == pytest.approx(expected[region], abs=0.03)
    assert "33" in report.verdict
    assert len(report.tables()[0].rows) == 3
    json.dumps(report.to_dict(), allow_nan=False)


def test_point_estimators_have_distances_only(traces: list[Trace]) -> None:
    points = [
        replace(
            trace,
            estimate_covariance=np.full_like(trace.estimate_covariance, np.nan),
            modality_mean=np.full_like(trace.modality_mean, np.nan),
        )
        for trace in traces
    ]
    report = calibrate(points[:40], points[40:], 0.9)
    assert list(report.calibration.layers) == ["fused"]
    layer = report.calibration.layers["fused"]
    assert (layer.scale, layer.ellipsoid) == (None, None)
    assert {c.region for c in report.coverage} == {"position", "angle"}
    assert all(c.share == pytest.approx(0.9225, abs=0.02) for c in report.coverage if c.phase == "all")


def test_too_few_episodes(traces: list[Trace]) -> None:
    with pytest.raises(BadInput, match="at least 19"):
        calibrate(traces[:18], traces[18:], 0.95)
    with pytest.raises(BadInput, match="to test"):
        calibrate(traces[:40], [], 0.9)
    with pytest.raises(BadInput, match=r"1\.5"):
        calibrate(traces[:40], traces[40:], 1.5)

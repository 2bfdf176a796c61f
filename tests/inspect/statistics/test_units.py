"""A state in km or nm has the NEES, likelihood and verdicts of the same state in m."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.inspect.diagnostics.planted_traces import real

from beliefscope.filters.covariance_floor import with_floor
from beliefscope.filters.evaluate import metrics
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

CODE = ("replay", "outline", "ridge_direction", "simulate", "camera")
MEANS = ("estimate_mean", "modality_mean", "start_mean", "particles")
COVARIANCES = ("estimate_covariance", "modality_covariance", "start_covariance")


def in_unit(run: Trace, unit: str, factor: float) -> Trace:
    """The run with its positions in another unit, displayed in cm as before, without functions in m."""
    scale = np.array([factor if component.unit == "m" else 1.0 for component in run.task.components])
    task = replace(
        run.task,
        components=tuple(
            replace(c, unit=unit, display=("cm", 100.0 / factor)) if c.unit == "m" else c for c in run.task.components
        ),
        map_half_width=factor * run.task.map_half_width,
        start_distance={},
        positions={},
        **dict.fromkeys(CODE),
    )
    arrays = {name: np.float32(getattr(run, name) * scale) for name in MEANS}
    arrays |= {name: np.float32(getattr(run, name) * scale * scale[:, None]) for name in COVARIANCES}
    return replace(
        run, episode=replace(run.episode, task=task, states=np.float32(run.episode.states * scale)), **arrays
    )


@pytest.fixture(scope="module")
def run() -> Trace:
    return in_unit(real("crossmodal-pf"), "m", 1.0)


@pytest.mark.parametrize(("unit", "factor"), [("km", 1e-3), ("nm", 1e9)])
def test_units_change_no_verdict(run: Trace, unit: str, factor: float) -> None:
    other = in_unit(run, unit, factor)
    np.testing.assert_allclose(measures.nees(other), measures.nees(run), rtol=1e-3, atol=1e-5)
    collapsed = run.estimate_covariance.copy()
    collapsed[-5:] = 0.0  # as of particles that are all equal
    first = replace(run, estimate_covariance=collapsed)
    values = [measures.nees(t)[-5:, -1] for t in (first, in_unit(first, unit, factor))]
    np.testing.assert_allclose(*values, rtol=1e-3)
    assert (values[0] > 1e4).all()
    assert measures.starts_at_truth(other) == measures.starts_at_truth(run) is True
    results, expected = quick(other), quick(run)
    assert {n: r.verdict for n, r in results.items()} == {n: r.verdict for n, r in expected.items()}
    assert {n: r.alarms for n, r in results.items()} == {n: r.alarms for n, r in expected.items()}


@pytest.mark.parametrize("factor", [1e-3, 1e9])
def test_log_likelihood_changes_by_the_jacobian(run: Trace, factor: float) -> None:
    other = in_unit(run, "km", factor)
    m, converted = (
        metrics(t.task, *map(torch.from_numpy, (measures.errors(t)[:, -1], t.estimate_covariance.astype(float))))
        for t in (run, other)
    )
    assert converted.nees == pytest.approx(m.nees, rel=1e-4)
    assert converted.coverage95 == m.coverage95
    assert converted.nll - m.nll == pytest.approx(2.0 * np.log(factor), abs=1e-4)


def test_floor_is_a_part_of_the_usual_variance() -> None:
    collapsed = np.array([np.diag([4.0, 9e12]), np.zeros((2, 2)), np.diag([6.0, np.nan])])
    floor = np.diagonal(with_floor(collapsed)[1])
    np.testing.assert_allclose(floor, [5e-8, 9e4])
    assert (np.linalg.eigvalsh(with_floor(np.zeros((2, 2)))) > 0.0).all()

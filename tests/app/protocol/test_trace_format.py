"""The numbers that the time line draws: they are the trace's, and those derived from it hold what their names say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from beliefscope.app.protocol.trace_format import columns, header
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.inspect.trace import Trace, trace

Columns = dict[str, np.ndarray[Any, Any]]


def of(name: str) -> tuple[Trace, Columns, dict[str, Any]]:
    """A shipped filter's trace of a door, its columns read as the page reads them, and its header."""
    with open_dataset(sample_path("door")) as episodes:
        run = trace(load_checkpoint(shipped("door", name)), episodes[9], particles=60)
    return read(run)


def read(run: Trace) -> tuple[Trace, Columns, dict[str, Any]]:
    described, buffer = columns(run)
    found = {
        one["name"]: np.frombuffer(buffer, "<f4", int(np.prod(one["shape"])), one["offset"]).reshape(one["shape"])
        for one in described
    }
    return run, found, header(run, described, find_task(run.episode.task), None)


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_nees_is_the_squared_error_over_the_covariance(name: str) -> None:
    run, found, _ = of(name)
    assert found["nees"].shape == (len(run), 3)
    for t in (0, 40, len(run) - 1):
        for layer in range(3):
            mean = run.estimate_mean[t] if layer == 2 else run.modality_mean[t, layer]
            covariance = run.estimate_covariance[t] if layer == 2 else run.modality_covariance[t, layer]
            error = (mean - run.episode.states[t]).astype(float)
            error[2] = np.arctan2(np.sin(error[2]), np.cos(error[2]))
            expected = error @ np.linalg.inv(covariance.astype(float)) @ error / 3
            # the floor on the diagonal, 1e-8 m^2 beside variances of 1e-5, and float32
            assert found["nees"][t, layer] == pytest.approx(expected, rel=5e-3)


def test_innovations_are_measured_less_predicted() -> None:
    run, found, _ = of("crossmodal-ekf")
    assert run.observation_mean is not None
    assert run.predicted_mean is not None
    assert run.observation_covariance is not None
    assert run.predicted_covariance is not None
    moved = run.observation_mean - run.predicted_mean
    moved[..., 2] = np.arctan2(np.sin(moved[..., 2]), np.cos(moved[..., 2]))
    np.testing.assert_allclose(found["innovation"], moved, atol=1e-5)
    claimed = np.diagonal(run.observation_covariance + run.predicted_covariance, axis1=-2, axis2=-1)
    np.testing.assert_allclose(found["innovation_sigma"] ** 2, claimed, rtol=1e-4)


def test_what_a_filter_has_not_is_left_out() -> None:
    _, found, head = of("crossmodal-pf")
    assert not {"innovation", "innovation_sigma"} & found.keys()
    assert head["nees_bounds"] is not None
    with open_dataset(sample_path("door")) as episodes:
        lstm = Checkpoint(build(architecture("door", "lstm")).eval(), "lstm", "", {})
        _, found, head = read(trace(lstm, episodes[9]))
    assert not {"nees", "estimate_sigma", "innovation"} & found.keys()
    assert head["nees_bounds"] is None


def test_the_bounds_hold_95_of_100_steps_of_a_consistent_filter() -> None:
    low, high = of("crossmodal-ekf")[2]["nees_bounds"]
    drawn = (np.random.default_rng(0).normal(size=(20_000, 3)) ** 2).mean(axis=1)
    inside = ((drawn > low) & (drawn < high)).mean()
    assert inside == pytest.approx(0.95, abs=0.005)  # its standard deviation is 0.0015

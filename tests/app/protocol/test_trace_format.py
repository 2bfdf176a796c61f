"""Columns and header of a trace."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beliefscope.app.protocol.trace_format import columns, header
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.inspect.trace import Trace, trace

Columns = dict[str, np.ndarray[Any, Any]]


def pretrained_run(name: str) -> tuple[Trace, Columns, dict[str, Any]]:
    """A run of a pretrained filter: trace, columns, header."""
    with open_dataset(sample_path("door")) as episodes:
        run = trace(load_checkpoint(pretrained_path("door", name)), episodes[9], particles=60)
    return read(run)


def read(run: Trace) -> tuple[Trace, Columns, dict[str, Any]]:
    descriptions, buffer = columns(run)
    values = {
        c["name"]: np.frombuffer(buffer, "<f4", int(np.prod(c["shape"])), c["offset"]).reshape(c["shape"])
        for c in descriptions
    }
    return run, values, header(run, descriptions, run.task, None, {})


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_nees_is_the_squared_error_over_the_covariance(name: str) -> None:
    run, values, _ = pretrained_run(name)
    assert values["nees"].shape == (len(run), 3)
    for t in (0, 40, len(run) - 1):
        for layer in range(3):
            mean = run.estimate_mean[t] if layer == 2 else run.modality_mean[t, layer]
            covariance = run.estimate_covariance[t] if layer == 2 else run.modality_covariance[t, layer]
            error = (mean - run.episode.states[t]).astype(float)
            error[2] = np.arctan2(np.sin(error[2]), np.cos(error[2]))
            expected = error @ np.linalg.inv(covariance.astype(float)) @ error / 3
            assert values["nees"][t, layer] == pytest.approx(expected, rel=1e-4)  # float32


def test_innovation_is_measured_minus_predicted() -> None:
    run, values, _ = pretrained_run("crossmodal-ekf")
    assert run.observation_mean is not None
    assert run.predicted_mean is not None
    assert run.observation_covariance is not None
    assert run.predicted_covariance is not None
    innovation = run.observation_mean - run.predicted_mean
    innovation[..., 2] = np.arctan2(np.sin(innovation[..., 2]), np.cos(innovation[..., 2]))
    np.testing.assert_allclose(values["innovation"], innovation, atol=1e-5)
    variance = np.diagonal(run.observation_covariance + run.predicted_covariance, axis1=-2, axis2=-1)
    np.testing.assert_allclose(values["innovation_sigma"] ** 2, variance, rtol=1e-4)


def test_unavailable_columns_are_omitted() -> None:
    _, values, head = pretrained_run("crossmodal-pf")
    assert not {"innovation", "innovation_sigma"} & values.keys()
    assert head["nees_bounds"] is not None
    with open_dataset(sample_path("door")) as episodes:
        lstm = Checkpoint(build(architecture("door", "lstm")).eval(), "lstm", "", {})
        _, values, head = read(trace(lstm, episodes[9]))
    assert not {"nees", "estimate_sigma", "innovation"} & values.keys()
    assert head["nees_bounds"] is None


def test_nees_bounds_contain_95_percent_for_a_consistent_filter() -> None:
    low, high = pretrained_run("crossmodal-ekf")[2]["nees_bounds"]
    samples = (np.random.default_rng(0).normal(size=(20_000, 3)) ** 2).mean(axis=1)
    inside = ((samples > low) & (samples < high)).mean()
    assert inside == pytest.approx(0.95, abs=0.005)  # the standard deviation is 0.0015


@pytest.mark.parametrize(
    ("faults", "steps"),
    [
        ("", None),
        ("blackout=0.4", None),  # at every step
        ("image_frozen:from=30:to=40", (30, 40)),
        ("force_bias=5:from=90,image_noise=40:from=95", (90, 100)),
        ("image_noise=40:from=500", None),  # after the end
    ],
)
def test_steps_with_injected_faults(faults: str, steps: tuple[int, int] | None) -> None:
    run, _, _ = pretrained_run("crossmodal-ekf")
    _, values, _ = read(replace(run, faults=Faults.parse(faults)))
    if steps is None:
        assert "faulty" not in values
    else:
        at = np.arange(len(run))
        np.testing.assert_array_equal(values["faulty"], (at >= steps[0]) & (at < steps[1]))

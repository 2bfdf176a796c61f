"""Columns and header of a trace."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.inspect.diagnosis.checks.test_innovations import BIAS, STD, Boat, sail

from beliefscope.app.protocol.trace_format import columns, header
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Component
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.statistics.channels import MAX_CHANNELS
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


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_update_sizes_are_in_standard_deviations_of_the_prediction(name: str) -> None:
    run, values, _ = pretrained_run(name)
    if run.predicted_mean is not None and run.predicted_covariance is not None:
        mean, variance = run.predicted_mean[:, 0, 0], run.predicted_covariance[:, 0, 0, 0]
    else:
        assert run.particles is not None
        assert run.prior_log_weights is not None
        weights, hinge_x = np.exp(run.prior_log_weights), run.particles[..., 0]
        mean = (weights * hinge_x).sum(1)
        variance = (weights * (hinge_x - mean[:, None]) ** 2).sum(1)
    expected = np.abs(run.modality_mean[:, :, 0] - mean[:, None]) / np.sqrt(variance)[:, None]
    np.testing.assert_allclose(values["update_size"][..., 0], expected, rtol=1e-2, atol=1e-3)


def test_unavailable_columns_are_omitted() -> None:
    _, values, head = pretrained_run("crossmodal-pf")
    assert not {"innovation", "innovation_sigma"} & values.keys()
    assert head["nees_bounds"] is not None
    assert head["first_counted"] == 30  # after the warm-up
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
        ("blackout=0.4", (0, 100)),
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


def boat_run(episode: Episode) -> Trace:
    """A run of a Kalman filter that reports its innovations; the radar has a reading at every fourth step."""
    adapter = Adapter(Boat(), batched=False, modalities=tuple(STD), initial_std=(0.5, 0.5, 0.1, BIAS))
    return trace(as_external(adapter, "boat", episode.task), episode)


def channels_of(run: Trace, column: str) -> list[tuple[str, str, float]]:
    """Names, units for display and scales of the channels of a column."""
    channels = next(c["channels"] for c in columns(run)[0] if c["name"] == column)
    return [(c["name"], c["display_unit"], c["scale"]) for c in channels]


def test_readings_are_those_that_the_filter_received_with_names_and_units() -> None:
    with open_dataset(sample_path("door")) as episodes:
        checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
        run = trace(checkpoint, episodes[9], faults=Faults.parse("force_bias:x=5"))
        _, values, _ = read(run)
        np.testing.assert_allclose(values["readings/force"][:, 0] - episodes[9].observations["force"][:, 0], 5.0)
    np.testing.assert_array_equal(values["readings/torque"], run.episode.observations["torque"])
    np.testing.assert_array_equal(values["readings/control"], run.episode.controls)
    assert "readings/image" not in values
    assert channels_of(run, "readings/force") == [(f"force {axis}", "N", 1.0) for axis in "xyz"]
    assert channels_of(run, "readings/effector_position")[2] == ("effector_position z", "cm", 100.0)


def test_steps_without_a_reading_are_nan() -> None:
    episode = sail(0)
    _, values, _ = read(boat_run(episode))
    present = np.isfinite(values["readings/radar"])
    np.testing.assert_array_equal(present, np.repeat(episode.present("radar")[:, None], 2, axis=1))
    assert np.isfinite(values["readings/compass"]).all()


def test_long_vectors_and_scans_have_no_column() -> None:
    episode = sail(0)
    many = np.zeros((len(episode), MAX_CHANNELS + 1), np.float32)
    sizes = {"ranges": MAX_CHANNELS, "tactile": MAX_CHANNELS + 1, "scan": 4}
    task = replace(
        episode.task,
        observations={**episode.task.observations, **{key: (size,) for key, size in sizes.items()}},
        scans={"scan": (-1.0, 1.0)},
    )
    readings = {**episode.observations, **{key: many[:, :size] for key, size in sizes.items()}}
    run = replace(boat_run(episode), episode=replace(episode, task=task, observations=readings))
    names = {c["name"] for c in columns(run)[0] if c["name"].startswith("readings/")}
    assert names == {"readings/radar", "readings/compass", "readings/ranges", "readings/control"}


def test_reported_innovations_have_the_channels_of_their_sensors() -> None:
    episode = sail(0)
    units = {"radar": (Component("range", "m"), Component("bearing", "rad"))}
    episode = replace(episode, task=replace(episode.task, channels=units))
    run, values, _ = read(boat_run(episode))
    assert run.innovation is not None
    assert run.innovation_covariance is not None
    assert "innovation" not in values
    for k, name in enumerate(run.modalities):
        np.testing.assert_array_equal(values[f"innovation/{name}"], run.innovation[:, k])
        variance = np.diagonal(run.innovation_covariance[:, k], axis1=1, axis2=2)
        np.testing.assert_allclose(values[f"innovation_sigma/{name}"] ** 2, variance, rtol=1e-5)
    names = [name for name, *_ in channels_of(run, "innovation/radar")]
    assert names == ["radar range", "radar bearing"]
    assert [unit for _, unit, _ in channels_of(run, "innovation_sigma/radar")] == ["cm", "deg"]
    assert channels_of(run, "innovation/compass")[0][:2] == ("compass", "")
    assert values["innovation/compass"].shape[1] == 2, "as wide in each block of a live run"


def test_innovations_of_many_channels_have_no_column() -> None:
    run = boat_run(sail(0))
    wide = np.zeros((len(run), 2, MAX_CHANNELS + 1))
    wide[:, 1, 1:] = np.nan
    covariance = np.broadcast_to(np.eye(MAX_CHANNELS + 1), (*wide.shape, MAX_CHANNELS + 1))
    _, values, _ = read(replace(run, innovation=wide, innovation_covariance=covariance))
    assert "innovation/radar" not in values
    assert values["innovation/compass"].shape == (len(run), MAX_CHANNELS)

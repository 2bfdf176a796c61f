"""Sensors of any kind: several images, RGB, arrays of numbers and long vectors, through every part of the program."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader
from torch import nn

from beliefscope.app.protocol.trace_format import columns, header
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults, available_presets
from beliefscope.datasets.point_clouds import MAX_POINTS, points_of
from beliefscope.datasets.store import open_dataset, write_dataset
from beliefscope.datasets.task import Component, Task
from beliefscope.datasets.task_json import check_definition, task_from_json, task_to_json
from beliefscope.filters.catalog import build
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Architecture
from beliefscope.inspect.catalog import DIAGNOSTICS, run_diagnostics
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.live_file import load_live
from beliefscope.inspect.traces.sensors import displayed_sensors, sensor_pixels
from beliefscope.recordings.export import export_trace
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.report.compose import compose, write_report
from beliefscope.recordings.write import write_recording

T = 12
TASK = Task(
    name="hand",
    components=(Component("x", "m"), Component("y", "m"), Component("z", "m"), Component("grip", "N")),
    observations={
        "left": (24, 32, 3),
        "right": (16, 16),
        "depth": (12, 10),
        "tactile": (4, 4, 2),
        "scan": (90,),
        "cloud": (7, 3),
    },
    modalities={"cameras": ("left", "right"), "range": ("depth", "scan", "cloud"), "touch": ("tactile",)},
    scans={"scan": (-np.pi / 2, np.pi / 2)},
    clouds=("cloud",),
    control_size=2,
    dt=0.05,
    map_components=("x", "y"),
    map_half_width=0.2,
    arrays=("depth", "tactile"),
    covariates={},
    warmup=0,
)


def make_episode(seed: int = 0) -> Episode:
    rng = np.random.default_rng(seed)
    observations: dict[str, Any] = {
        key: rng.integers(1, 256, (T, *shape)).astype(np.uint8)
        if TASK.dtype(key) is np.uint8
        else rng.normal(size=(T, *shape)).astype(np.float32)
        for key, shape in TASK.observations.items()
    }
    observations["left"][5] = [3, 5, 7]  # one colour
    states = rng.normal(size=(T, 4)).astype(np.float32)
    return Episode(
        task=TASK,
        states=states,
        controls=np.zeros((T, 2), np.float32),
        observations=observations,
        contact=np.zeros(T, bool),
        qpos=np.zeros((T, 0), np.float32),
        dt=0.05,
        seed=seed,
        split="test",
    )


class Reader(nn.Module):
    """Estimates from the mean of every sensor, so that each reading reaches the filter."""

    def initialize_beliefs(self, *, mean: torch.Tensor, covariance: torch.Tensor) -> None:
        self.mean = mean

    def forward(self, *, observations: dict[str, torch.Tensor], controls: torch.Tensor) -> Any:
        means = [values.double().flatten(1).mean(1) for values in observations.values()]
        estimate = torch.stack(means, dim=1)[:, :4].to(self.mean.dtype)
        return estimate, torch.eye(4).expand(len(estimate), 4, 4)


@pytest.fixture(scope="module")
def run() -> Trace:
    return trace(ExternalFilter(Adapter(Reader(), mean=4 * (0.0,), std=4 * (1.0,)), TASK, "reader"), make_episode())


@pytest.mark.slow
def test_data_set_and_definition(tmp_path: Path) -> None:
    path = tmp_path / "hand.h5"
    write_dataset(path, TASK, [make_episode(0), make_episode(1)])
    with open_dataset(path) as data:
        assert data.task == TASK
        assert data[1].digest() == make_episode(1).digest()
    with h5py.File(path, "r+") as file:
        group = file["trajectory0/observations"]
        values = group["depth"][()].astype(np.uint8)
        del group["depth"]
        group["depth"] = values
    with open_dataset(path) as data, pytest.raises(BadInput, match="depth' of trajectory0 is uint8, expected float32"):
        data[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arrays": ()}, r"'tactile' has shape \(4, 4, 2\), expected \(d,\), \(H, W\) or \(H, W, 3\), or its name"),
        ({"arrays": ("depth", "tactile", "heat")}, "arrays has 'heat', which is not an observation"),
        ({"observations": TASK.observations | {"scan": ()}}, r"observation 'scan' has shape \(\)"),
        ({"scans": {"depth": (0.0, 1.0)}}, r"scan 'depth' has shape \(12, 10\), expected ranges \(d,\)"),
        ({"scans": {"scan": (1.0, 0.0)}}, r"scan 'scan' has angles \(1.0, 0.0\), expected two in rad, ascending"),
        ({"scans": {"lidar": (0.0, 1.0)}}, r"scan 'lidar' has shape \(\)"),
        ({"clouds": ("scan", "cloud")}, r"point cloud 'scan' has shape \(90,\), expected \(P, 2\), \(P, 3\)"),
        ({"modalities": {"none": ()}}, "modality 'none' has no observations"),
    ],
)
def test_invalid_sensors_are_rejected(change: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        check_definition(replace(TASK, **change))


def test_definitions_without_arrays_are_read() -> None:
    values = task_to_json(
        replace(TASK, observations={"scan": (90,)}, modalities={"range": ("scan",)}, arrays=(), clouds=())
    )
    del values["arrays"]
    assert task_from_json(json.loads(json.dumps(values))).arrays == ()


def test_built_in_filters_name_the_sensors_that_they_do_not_take() -> None:
    with pytest.raises(
        BadInput, match=r"modality 'cameras' .* has left \(24, 32, 3\), right \(16, 16\); .* gray image"
    ):
        build(Architecture(TASK, "ekf", "unimodal", ("cameras", "range")))


def test_every_reading_reaches_an_external_filter(run: Trace) -> None:
    readings = run.episode.observations
    expected = [readings[key].reshape(T, -1).mean(1) for key in ("left", "right", "depth", "tactile")]
    np.testing.assert_allclose(run.estimate_mean, np.stack(expected, axis=1), rtol=1e-5, atol=1e-6)


def test_blackouts_and_displayed_sensors(run: Trace) -> None:
    assert measures.blackout(run).tolist() == [t == 5 for t in range(T)]
    assert [(s.name, s.channels, s.points) for s in displayed_sensors(run)] == [
        ("left", 3, 0),
        ("right", 1, 0),
        ("depth", 1, 0),
        ("scan", 1, 90),
        ("cloud", 1, 7),
    ]
    np.testing.assert_array_equal(sensor_pixels(run, "left"), run.episode.observations["left"])
    depth, low = run.episode.observations["depth"], displayed_sensors(run)[2].low
    pixels = sensor_pixels(run, "depth")
    assert (pixels.min(), pixels.max()) == (0, 255)
    high = displayed_sensors(run)[2].high
    assert low is not None
    assert high is not None
    span = high - low
    np.testing.assert_allclose(low + pixels / 255.0 * span, depth, atol=span / 255.0)
    assert header(run, columns(run)[0], TASK, None, {})["sensors"][0].width == 32


def test_points_of_scans_and_clouds(run: Trace, tmp_path: Path) -> None:
    """Beams from right to left of the sensor, whose x axis is at 0 rad; ranges that are not above 0 are absent."""
    ranges = run.episode.observations["scan"]
    points = sensor_pixels(run, "scan")
    present = ranges > 0.0
    np.testing.assert_array_equal(np.isfinite(points[..., 0]), present)
    np.testing.assert_allclose(np.hypot(*points[present].T), ranges[present], rtol=1e-5)
    angle = np.broadcast_to(np.linspace(-np.pi / 2, np.pi / 2, 90), ranges.shape)
    np.testing.assert_allclose(np.arctan2(points[..., 1], points[..., 0])[present], angle[present], atol=1e-5)
    cloud = run.episode.observations["cloud"].copy()
    cloud[3, 2] = 0.0
    absent = replace(run, episode=replace(run.episode, observations={**run.episode.observations, "cloud": cloud}))
    assert np.isnan(sensor_pixels(absent, "cloud")).any(-1).sum() == 1
    many = points_of(TASK, "cloud", np.ones((2, 90_000, 4), np.float32))
    assert many.shape == (2, MAX_POINTS, 3)
    drawn = {"/points/cloud": 0, "/points/scan": 0}
    for chunk in RrdReader(write_recording(absent, tmp_path / "run.rrd")).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path in drawn and "Points3D:positions" in batch.schema.names:
            drawn[chunk.entity_path] += len(batch.column("Points3D:positions").flatten())
    assert drawn == {"/points/cloud": 7 * T - 1, "/points/scan": int(present.sum())}


@pytest.mark.long
@pytest.mark.slow
def test_recording_live_file_export_and_report(run: Trace, tmp_path: Path) -> None:
    stored = read_recording(write_recording(run, tmp_path / "run.rrd"))
    for key, readings in run.episode.observations.items():
        np.testing.assert_array_equal(stored.episode.observations[key], readings)
        assert stored.episode.observations[key].dtype == readings.dtype
    with LiveRecorder("run", task=TASK, folder=tmp_path, views=False) as live:
        for t in range(T):
            live.step(run.estimate_mean[t], {k: v[t] for k, v in run.episode.observations.items()})
    live_run = load_live(live.path)
    for key, readings in run.episode.observations.items():
        np.testing.assert_array_equal(live_run.episode.observations[key], readings)
    for suffix in (".npz", ".parquet", ".mcap"):
        export_trace(run, tmp_path / f"run{suffix}")
    write_report(compose([run], None, files=[tmp_path / "run.rrd"]), tmp_path / "report")
    assert (tmp_path / "report" / "report.html").is_file()


def test_diagnostics_are_computed_or_refused_with_a_reason(run: Trace) -> None:
    results, reasons = run_diagnostics([run], None, {name: {} for name in DIAGNOSTICS}, True)
    assert "consistency" in results
    assert all(reasons.values())


@pytest.mark.parametrize("key", TASK.observations)
def test_faults_of_any_sensor(key: str) -> None:
    clean = make_episode()
    readings = clean.observations[key].astype(float)

    def inject(text: str) -> Any:
        changed = Faults.parse(text).apply(clean)
        assert all((changed.observations[k] == v).all() for k, v in clean.observations.items() if k != key)
        return changed.observations[key].astype(float)

    is_image, last = clean.observations[key].dtype == np.uint8, readings.shape[-1]
    limited = (lambda values: np.rint(values).clip(0, 255)) if is_image else (lambda values: values)
    np.testing.assert_allclose(inject(f"sensor_bias={key}:offset=3"), limited(readings + 3.0), rtol=1e-5, atol=1e-6)
    drift = 3.0 * TASK.dt * np.arange(len(readings)).reshape(-1, *(1,) * (readings.ndim - 1))
    np.testing.assert_allclose(inject(f"sensor_drift={key}:rate=3"), limited(readings + drift), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(inject(f"sensor_gain={key}:factor=0.5"), limited(0.5 * readings), rtol=1e-5, atol=1e-6)
    assert (inject(f"sensor_frozen={key}:from=4")[4:] == readings[4]).all()
    noisy = inject(f"sensor_noise={key}:std=0.1")
    assert is_image or np.std(noisy - readings) == pytest.approx(0.1, rel=0.2)
    modality = next(name for name, keys in TASK.modalities.items() if key in keys)
    delayed = Faults.parse(f"delay={modality}:steps=2").apply(clean).observations[key]
    np.testing.assert_array_equal(delayed[2:], clean.observations[key][:-2])
    dropped = Faults.parse(f"drop={modality}:from=3").apply(clean).observations[key]
    assert np.array_equal(dropped[:3], clean.observations[key][:3])
    assert len(np.unique(dropped[3:].reshape(T - 3, -1), axis=0)) == 1
    if readings.ndim == 3:
        with pytest.raises(BadInput, match="channel that the sensor does not have"):
            inject(f"sensor_swapped={key}")
    else:
        swapped = inject(f"sensor_swapped={key}:first=0:second={last - 1}")
        np.testing.assert_array_equal(swapped[..., [0, -1]], readings[..., [-1, 0]])


def test_image_faults_of_rgb_images_change_every_channel() -> None:
    task = replace(
        TASK, observations={"image": (24, 32, 3)}, modalities={"image": ("image",)}, arrays=(), scans={}, clouds=()
    )
    clean = make_episode()
    clean = replace(clean, task=task, observations={"image": clean.observations["left"]})
    for text in ("image_blur=1", "image_shift=3", "image_occluded=8", "image_noise=20", "blackout"):
        image = Faults.parse(text).apply(clean).observations["image"]
        assert image.shape == clean.observations["image"].shape
        assert (image != clean.observations["image"]).any(axis=(0, 1, 2)).all()
    # Channels are blurred by themselves: the blur of the channels equals the channels of the blur.
    blurred = Faults.parse("image_blur=1").apply(clean).observations["image"]
    gray = replace(task, observations={"image": (24, 32)})
    alone = replace(clean, task=gray, observations={"image": clean.observations["image"][..., 1]})
    np.testing.assert_array_equal(Faults.parse("image_blur=1").apply(alone).observations["image"], blurred[..., 1])


def test_presets_fit_the_sensors() -> None:
    presets = available_presets(TASK)
    assert presets["depth frozen"] == "sensor_frozen=depth:from=20"
    assert presets["touch lost"] == "drop=touch:from=20"
    for text in presets.values():
        Faults.parse(text).check(TASK)

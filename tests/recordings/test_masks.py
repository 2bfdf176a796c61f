"""Absent readings: every file keeps the mask, filters receive it, and sensor checks and faults respect it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.episode import Episode, hold, outages
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, write_dataset
from beliefscope.datasets.task import Component, Task
from beliefscope.datasets.task_json import check_definition
from beliefscope.filters.external.ablation import without
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.diagnosis.checks.sensors import localise, sensor_statistics
from beliefscope.inspect.slices.covariates import _step_columns
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace
from beliefscope.inspect.traces.live_file import LiveFileReader
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.columns import read_columns
from beliefscope.recordings.log_readers.read_log import check_complete, read_log
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.write import write_recording

STEPS, NOISE = 200, 0.05
TASK = Task(
    name="cart",
    components=(Component("x", "m"),),
    observations={"gps": (1,), "camera": (8, 8)},
    modalities={"gps": ("gps",), "camera": ("camera",)},
    control_size=1,
    dt=0.1,
    covariates={"fix": Covariate("boolean"), "image": Covariate("boolean")},
    masks={"gps": "fix", "camera": "image"},
    warmup=0,
)


class Kalman:
    """A scalar Kalman filter that updates only at steps with a GPS reading."""

    def initialize_beliefs(self) -> tuple[np.ndarray, np.ndarray]:
        self.x, self.p = np.zeros((1, 1)), np.ones((1, 1, 1))
        return self.x, self.p

    def forward(self, observations: dict[str, Any], controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.x, self.p = self.x + 0.1 * controls, self.p + 1e-4
        gain = observations["gps.present"][:, None] * self.p[:, 0] / (self.p[:, 0] + NOISE**2)
        self.x = self.x + gain * (observations["gps"] - self.x)
        self.p = self.p * (1.0 - gain[..., None])
        return self.x, self.p


@pytest.fixture(scope="module")
def episode() -> Episode:
    """GPS readings at 60 % of the steps, none from 100 to 139, and an image at every second or third step."""
    rng = np.random.default_rng(0)
    speed = 0.75 + 0.2 * np.sin(np.arange(STEPS)[:, None] / 20)
    x = np.cumsum(0.1 * speed, axis=0)
    fix, image = rng.random(STEPS) < 0.6, np.arange(STEPS) % 5 % 2 == 0
    fix[100:140] = False
    observations = {
        "gps": hold(x + rng.normal(0, NOISE, x.shape), fix),
        "camera": hold(rng.integers(0, 255, (STEPS, 8, 8)).astype(np.uint8), image),
    }
    masks = {"fix": fix.astype(np.float32), "image": image.astype(np.float32)}
    return Episode(TASK, x, speed, observations, covariates=masks)


@pytest.fixture(scope="module")
def run(episode: Episode) -> Trace:
    return trace(as_external(Adapter(Kalman(), task=TASK), "kalman"), episode)


def test_readings_are_held() -> None:
    present = np.array([False, True, False, False, True])
    assert hold(np.arange(10, 15), present).tolist() == [0, 11, 11, 11, 14]


def test_a_filter_receives_the_mask(run: Trace, episode: Episode) -> None:
    """The variance grows by its process noise alone exactly where readings are absent."""
    growth = np.diff(run.estimate_covariance[:, 0, 0])
    np.testing.assert_array_equal(np.isclose(growth, 1e-4, atol=1e-7), ~episode.present("gps")[1:])
    assert set(measures.shaded_groups(run)) == {"no fix", "no image"}
    np.testing.assert_array_equal(measures.shaded_groups(run)["no fix"], outages(~episode.present("gps")))


def test_every_file_keeps_the_mask(
    run: Trace, episode: Episode, assert_same: Callable[..., None], tmp_path: Path
) -> None:
    write_dataset(tmp_path / "cart.h5", TASK, [episode])
    with open_dataset(tmp_path / "cart.h5") as data:
        assert np.array_equal(data[0].present("gps"), episode.present("gps"))
    save_trace(run, tmp_path / "run.trace")
    assert_same(load_trace(tmp_path / "run.trace"), run)
    loaded = read_recording(write_recording(run, tmp_path / "run.rrd"))
    assert np.array_equal(loaded.episode.present("camera"), episode.present("camera"))


def test_a_live_run_holds_absent_readings(episode: Episode, tmp_path: Path) -> None:
    """The first step has no GPS reading, later ones only where the sensor gives one."""
    present = {key: episode.present(key) & (np.arange(STEPS) > 0) for key in TASK.observations}
    with LiveRecorder("cart", task=TASK, folder=tmp_path, views=False) as live:
        for t in range(20):
            live.step(np.zeros(1), {key: episode.observations[key][t] for key in present if present[key][t]})
    reader = LiveFileReader(live.path)
    reader.poll()
    part = reader.part().episode
    for key, mask in present.items():
        np.testing.assert_array_equal(part.present(key), mask[:20])
        np.testing.assert_array_equal(part.observations[key], hold(episode.observations[key][:20], mask[:20]))


def test_sensor_checks_ignore_absent_readings(episode: Episode) -> None:
    """Held readings are no frozen sensor and do not change its noise; without the mask they would be frozen."""
    statistics = sensor_statistics(episode, None)
    assert statistics["frozen/camera/all"] == statistics["stuck/gps/all"] == 0.0
    assert statistics["noise/gps/all"] == pytest.approx(NOISE, rel=0.25)
    unmasked = sensor_statistics(replace(episode, task=replace(TASK, masks={})), None)
    assert unmasked["frozen/camera/all"] > 0.35
    assert unmasked["stuck/gps/all"] > 0.35


def test_faults_change_readings_only(episode: Episode) -> None:
    """Absent readings stay held; a frozen sensor is still found among the present ones."""
    present = episode.present("gps")
    noisy = Faults.parse("sensor_noise=gps:std=1").apply(episode)
    np.testing.assert_array_equal(noisy.observations["gps"], hold(noisy.observations["gps"], present))
    np.testing.assert_array_equal(noisy.present("gps"), present)
    frozen = Faults.parse("sensor_frozen=gps:from=20:to=80").apply(episode)
    share = sensor_statistics(frozen, None)["stuck/gps/all"]
    assert share == pytest.approx(present[20:80].sum() / present.sum(), abs=2 / present.sum())
    first, last = localise("stuck/gps/all", frozen, None) or (0, 0)
    assert 20 <= first <= 24
    assert 76 <= last < 80


def test_delays_and_dropouts_move_the_mask(episode: Episode) -> None:
    present = episode.present("gps")
    late = Faults.parse("delay=gps:steps=5").apply(episode)
    np.testing.assert_array_equal(late.present("gps")[5:], present[:-5])
    np.testing.assert_array_equal(late.observations["gps"][5:], episode.observations["gps"][:-5])
    dropped = Faults.parse("drop=gps:from=20:to=30").apply(episode)
    assert not dropped.present("gps")[20:30].any()
    np.testing.assert_array_equal(dropped.present("gps")[30:], present[30:])
    assert not without(episode, ["gps"], "mean").present("gps").any()
    np.testing.assert_array_equal(dropped.present("camera"), episode.present("camera"))


def test_import_finds_absent_readings(tmp_path: Path) -> None:
    """Empty cells and ``valid`` make masks; the log becomes a data set."""
    log = ["t,x,gps_x,gps_y,odo,fix"]
    log += [f"{t / 10},{t},{f'{t},{t}' if t % 7 < 3 else ','},{t // 4},{int(t % 4 == 0)}" for t in range(40)]
    (tmp_path / "log.csv").write_text("\n".join(log))
    text = 'time = "t"\n[state]\nx = "x"\n[sensors]\ngps = ["gps_x", "gps_y"]\n'
    (tmp_path / "map.toml").write_text(text + 'odo = {column = "odo", valid = "fix"}\n')
    mapping = read_map(tmp_path / "map.toml")
    (episode,) = episodes = read_log(read_columns(tmp_path / "log.csv", mapping), mapping, "log.csv")
    check_complete(episodes)
    steps = np.arange(40)
    assert episode.task.masks == {"gps": "gps reading", "odo": "odo reading"}
    np.testing.assert_array_equal(episode.present("gps"), steps % 7 < 3)
    np.testing.assert_array_equal(episode.present("odo"), steps % 4 == 0)
    np.testing.assert_array_equal(episode.observations["gps"][:, 0], steps - np.maximum(steps % 7 - 2, 0))
    (tmp_path / "map.toml").write_text(text + 'odo = {column = "odo", vald = "fix"}\n')
    with pytest.raises(
        BadInput, match=r"sensor 'odo' is .*expected columns or \{column = NAME, valid = NAME, unit = UNIT\}"
    ):
        read_map(tmp_path / "map.toml")


@pytest.mark.parametrize("masks", [{"gps": "speed"}, {"radar": "fix"}, {"gps": "fix", "camera": "fix"}])
def test_invalid_masks_are_refused(masks: dict[str, str]) -> None:
    with pytest.raises(BadInput, match="expected an observation and a boolean covariate of its own: fix, image"):
        check_definition(replace(TASK, masks=masks))


def test_a_recording_keeps_names_with_spaces_and_signs(
    episode: Episode, assert_same: Callable[..., None], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    names = {"gps": "GPS [rover]", "camera": "caméra n° 2"}
    task = replace(
        TASK,
        components=(Component("Ort ψ", "m"),),
        map_components=("Ort ψ",),
        observations={names[key]: shape for key, shape in TASK.observations.items()},
        modalities={names[key]: (names[key],) for key in TASK.modalities},
        covariates={"GPS [rover] reading": Covariate("boolean")},
        masks={"GPS [rover]": "GPS [rover] reading"},
    )
    named = replace(
        episode,
        task=task,
        observations={names[key]: readings for key, readings in episode.observations.items()},
        covariates={"GPS [rover] reading": episode.covariates["fix"]},
    )
    still = Adapter(lambda observations, controls: (controls, np.ones((STEPS, 1, 1, 1))), task=task)
    run = trace(as_external(still, "still"), named)
    assert_same(read_recording(write_recording(run, tmp_path / "run.rrd")), run)
    assert "entity path" not in capfd.readouterr().err


def test_slices_have_no_reading_before_the_first_one(run: Trace, episode: Episode) -> None:
    late = np.concatenate([np.zeros(10, np.float32), episode.covariates["image"][10:]])
    camera = hold(episode.observations["camera"], late > 0)
    part = replace(
        episode,
        covariates={**episode.covariates, "image": late},
        observations={**episode.observations, "camera": camera},
    )
    columns = {name: values for name, _, values in _step_columns(replace(run, episode=part), TASK)}
    first = int(late.argmax())
    assert np.isnan(columns["camera brightness"][:first]).all()
    np.testing.assert_allclose(columns["camera brightness"][first:], camera[first:].mean((1, 2)))

"""``beliefscope diagnose`` of recorded runs, whose filter is not available."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import beliefscope as bs

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]

MAP = """
task = "tram"
dt = 0.1
episode = "episode"
control = "speed"
[state]
x = "x"
[sensors]
odometer = "odometer"
beacon = "beacon"
[estimate]
mean = ["mean"]
std = ["std"]
"""

STEPS = 100


def logs(
    count: int, seed: int, bias: float = 0.0, noise: float = 0.1, speed_gain: float = 1.0
) -> dict[str, np.ndarray]:
    """A Kalman filter of a tram on a line with an odometer (standard deviation 0.1 m) and a beacon (0.2 m).

    Args:
        bias: of the beacon, m. noise: of the dynamics that the filter assumes, m. speed_gain: of the filter.
    """
    rng = np.random.default_rng(seed)
    rows: dict[str, list[float]] = {k: [] for k in ("episode", "speed", "x", "odometer", "beacon", "mean", "std")}
    for episode in range(count):
        x, mean, variance, phase = 0.0, 0.0, 0.01, rng.uniform(0.0, 6.0)
        for step in range(STEPS):
            speed = 5.0 * np.sin(0.1 * step + phase)
            x += 0.1 * speed + rng.normal(0.0, 0.1)
            readings = {"odometer": x + rng.normal(0.0, 0.1), "beacon": x + bias + rng.normal(0.0, 0.2)}
            mean, variance = mean + 0.1 * speed_gain * speed, variance + noise**2
            for reading, r in zip(readings.values(), (0.1, 0.2), strict=True):
                gain = variance / (variance + r**2)
                mean, variance = mean + gain * (reading - mean), (1.0 - gain) * variance
            values = {"episode": episode, "speed": speed, "x": x, **readings, "mean": mean, "std": np.sqrt(variance)}
            for name, value in values.items():
                rows[name].append(value)
    return {name: np.array(values) for name, values in rows.items()}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of logs and their map."""
    folder = tmp_path_factory.mktemp("tram")
    (folder / "map.toml").write_text(MAP)
    np.savez(folder / "clean.npz", **logs(30, 1))
    np.savez(folder / "again.npz", **logs(6, 2))
    np.savez(folder / "biased.npz", **logs(6, 3, bias=0.5))
    np.savez(folder / "sure.npz", **logs(6, 4, noise=0.01))
    np.savez(folder / "wrong.npz", **logs(6, 5, speed_gain=0.5))
    return folder


@pytest.fixture
def diagnose(run: Run, recordings: Path) -> Callable[[str], str]:
    """Headline of the diagnosis of a log, with the clean one as healthy record."""

    def headline(name: str) -> str:
        for log in (name, "clean"):
            if not (recordings / log).is_dir():
                path, mapping = recordings / f"{log}.npz", recordings / "map.toml"
                assert run("import", path, "--map", mapping, "-o", recordings / log)[0] == 0
        code, output, error = run("diagnose", recordings / name, "--profile-from", recordings / "clean")
        assert code == 0, error
        return output.splitlines()[0]

    return headline


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("name", "headline"),
    [
        pytest.param("again", "Healthy: ", marks=pytest.mark.long),
        ("biased", "Sensor beacon biased, "),
        pytest.param("sure", "Covariance of the filter too small, ", marks=pytest.mark.long),
        ("wrong", "Filter changed, while its readings show no fault, "),
    ],
)
def test_a_fault_of_recorded_runs_is_named(diagnose: Callable[[str], str], name: str, headline: str) -> None:
    assert diagnose(name).startswith(headline)


@pytest.mark.long
def test_recorded_runs_need_healthy_ones(run: Run, diagnose: Callable[[str], str], recordings: Path) -> None:
    diagnose("again")
    code, _, error = run("diagnose", recordings / "again")
    assert code == 2
    assert "recorded runs need a healthy record: give a folder of at least 10 recorded runs without a fault" in error
    code, _, error = run("diagnose --repair 0", recordings / "again", "--profile-from", recordings / "clean")
    assert code == 2
    assert "recorded runs are diagnosed as they are" in error


def test_a_report_of_recorded_runs_has_their_diagnosis(
    run: Run, diagnose: Callable[[str], str], recordings: Path, tmp_path: Path
) -> None:
    headline, folders = diagnose("biased"), (recordings / "biased", recordings / "clean")
    code, text, error = run("report", folders[0], "--profile-from", folders[1], "-o", tmp_path / "report")
    assert code == 0, error
    assert text.startswith(f"Diagnosis: {headline}")
    manifest = json.loads((tmp_path / "report" / "manifest.json").read_text())
    assert manifest["diagnosis"] == headline
    assert f"--profile-from {folders[1]}" in manifest["commands"][-1]


@pytest.mark.long
def test_recorded_runs_are_diagnosed_in_python(diagnose: Callable[[str], str], recordings: Path) -> None:
    headline = diagnose("biased")
    diagnosis = bs.diagnose_runs(str(recordings / "biased"), recordings / "clean")
    assert (diagnosis.headline, diagnosis.causes[0].cause.name) == (headline, "beacon.bias")
    traces = [bs.load_trace(path) for path in sorted((recordings / "biased").iterdir())]
    assert bs.diagnose_runs(traces, recordings / "clean").headline == headline
    with pytest.warns(UserWarning, match="the healthy record contains 6 of the 6 diagnosed episodes"):
        bs.diagnose_runs(traces, [*traces, *(bs.load_trace(path) for path in sorted((recordings / "clean").iterdir()))])
    with pytest.raises(bs.BadInput, match="runs has no recorded runs"):
        bs.diagnose_runs([], recordings / "clean")


@pytest.mark.long
def test_the_files_of_recorded_runs_are_listed(
    run: Run, diagnose: Callable[[str], str], recordings: Path, tmp_path: Path
) -> None:
    """Also of runs with the same index of the episode, whose order is that of the numbers in their names."""
    diagnose("biased")
    source = recordings / "biased" / "biased-0.trace"
    for number in (2, 10):
        (tmp_path / f"run_{number}.trace").write_bytes(source.read_bytes())
    code, text, error = run("diagnose", tmp_path, "--profile-from", recordings / "clean")
    assert code == 0, error
    assert [line.split() for line in text.splitlines()[-2:]] == [["0", "run_2.trace"], ["1", "run_10.trace"]]
    code, text, error = run("inspect --only consistency --json -", tmp_path)
    assert code == 0, error
    assert [entry["path"] for entry in json.loads(text)["traces"]] == [
        str(tmp_path / f"run_{number}.trace") for number in (2, 10)
    ]


def test_a_task_needs_a_filter(run: Run) -> None:
    code, _, error = run("diagnose door")
    assert code == 2
    assert error == "error: --filter is missing: the filter that runs over the episodes of task door\n"


def test_a_missing_folder_of_runs_is_named(run: Run) -> None:
    code, _, error = run("diagnose traces/none --profile-from traces/healthy")
    assert code == 2
    assert error == "error: traces/none does not exist: expected a recorded run, a folder with some, or a task\n"

"""A study with the smoke schedule: killed and resumed, shared between processes, with failed cells, and its outputs."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import signal
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from beliefscope.app.cli.main import main
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint
from beliefscope.filters.training import study
from beliefscope.filters.training.plan import BLACKOUTS, EVALUATED_BLACKOUTS
from beliefscope.filters.training.study import Cell, run_cell, run_cells
from beliefscope.filters.training.study_table import OFFSET, TRIVIAL, TRUTH, rows_of, to_markdown

pytestmark = pytest.mark.slow

FILTERS = ("haptics-ekf", "lstm")
NAMES = [f"door/{name}/seed{seed}" for seed in range(2) for name in FILTERS]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, short_episodes: Callable[..., list[Episode]]) -> Path:
    """Two training episodes, one validation and two test episodes; the first 45 steps of each."""
    path = tmp_path_factory.mktemp("data") / "door.h5"
    with open_dataset(sample_path("door")) as dataset:
        by_split = {s: [e.index for e in dataset.summaries if e.split == s] for s in ("train", "val", "test")}
    indices = by_split["train"][:2] + by_split["val"][:1] + by_split["test"][:2]
    write_dataset(path, find_task("door"), short_episodes("door", indices, 45))
    return path


def arguments(data: Path, folder: Path, *more: str) -> list[str]:
    filters = [word for name in FILTERS for word in ("--filter", name)]
    options = ["--preset", "smoke", "--task", "door", "--data", f"door={data}", *filters, "--seeds", "2"]
    return ["study", *options, *more, "-o", str(folder)]


def run(words: list[str]) -> int:
    """Runs a command line in this process; returns its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["beliefscope", *words])
        with pytest.raises(SystemExit) as end:
            main()
    return int(end.value.code or 0)


def kill_when(words: list[str], reached: Callable[[], bool]) -> None:
    """Runs a command line in another process and kills it with SIGKILL as soon as ``reached`` returns true."""
    words = [sys.executable, "-m", "beliefscope", *words]
    # The same number of threads as here, since the order of sums affects rounding.
    env = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=env)
    try:
        for _ in range(60_000):
            if reached():
                break
            assert process.poll() is None, "ended before it could be killed"
            time.sleep(0.002)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert reached()


def without_seconds(path: Path) -> str:
    """Hash of a checkpoint without the duration of its training."""
    checkpoint = load_checkpoint(path)
    record = {key: value for key, value in checkpoint.record.items() if key != "seconds"}
    return save_checkpoint(checkpoint.filter, checkpoint.name, record, path.with_name("compared.safetensors"))


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a finished study that was not interrupted."""
    folder = tmp_path_factory.mktemp("finished") / "study"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("beliefscope.recordings.study_figures.write_results", lambda rows, folder, tasks: [])
        assert run(arguments(data, folder)) == 0
    with redirect_stdout(io.StringIO()) as out:  # draws the figures once instead of after each cell
        assert run(arguments(data, folder, "--json", "-")) == 0
    written = json.loads((folder / "study.json").read_text())
    assert json.loads(out.getvalue()) == written | {"path": str(folder)}
    assert written["cells"] == dict.fromkeys(NAMES, "finished")
    return folder


def document(folder: Path, name: str) -> dict[str, Any]:
    return json.loads((folder / "cells" / f"{name}.json").read_text())


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("beliefscope.recordings.study_figures.write_results", lambda rows, folder, tasks: [])


@pytest.mark.long
@pytest.mark.usefixtures("no_figures")
def test_killed_study_resumes_to_the_same_results(data: Path, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "study"
    first = folder / "cells" / f"{NAMES[0]}.json"
    partial = folder / "cells" / f"{NAMES[1]}.safetensors.partial"
    kill_when(arguments(data, folder), lambda: first.exists() and partial.exists())
    before = first.stat().st_mtime_ns
    overview = json.loads((folder / "study.json").read_text())
    assert overview["cells"][NAMES[3]] == "missing"
    assert f"| {FILTERS[1]} | 80% | 0 of 2 | missing |" in (folder / "table.md").read_text()

    assert run(arguments(data, folder)) == 0
    assert first.stat().st_mtime_ns == before, "finished cells do not run again"
    assert not partial.exists()
    for name in NAMES:
        paths = [study / "cells" / f"{name}.safetensors" for study in (finished, folder)]
        assert without_seconds(paths[0]) == without_seconds(paths[1])
        first_run, resumed = document(finished, name), document(folder, name)
        for key in ("seconds", "checkpoint_hash"):
            first_run.pop(key), resumed.pop(key)
        assert first_run == resumed


def test_tables_contain_the_results_of_the_cells(finished: Path) -> None:
    with (finished / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [(row["start_offset"], row["filter"], row["blackout"]) for row in table] == [
        *((start, name, str(b)) for start in ("3cm,20deg", "") for name in FILTERS for b in EVALUATED_BLACKOUTS),
        ("", TRIVIAL, ""),
    ]
    markdown = (finished / "table.md").read_text()
    for row in table[:-1]:
        cells = [document(finished, f"door/{row['filter']}/seed{seed}") for seed in range(2)]
        start = OFFSET if row["start_offset"] else TRUTH
        fused = [cell[start][f"{float(row['blackout']):g}"]["fused"] for cell in cells]
        for part, selector in {
            "from_step_0": lambda metrics: metrics["rmse_from_step_0"],
            "stay": lambda metrics: metrics["baselines"]["stay"]["rmse"],
            "dynamics": lambda metrics: (metrics["baselines"]["dynamics"] or {}).get("rmse"),
        }.items():
            values = [selector(metrics) for metrics in fused]
            expected = "" if values[0] is None else statistics.fmean(value["angle_deg"] for value in values)
            written = row[f"angle_deg_{part}"]
            assert written == expected or float(written) == pytest.approx(expected, rel=1e-12), part
        numbers = {key: [metrics["rmse"][key] for metrics in fused] for key in fused[0]["rmse"]}
        numbers |= {key: [metrics[key] for metrics in fused] for key in ("nll", "nees", "coverage95")}
        numbers["seconds"] = [cell["seconds"] for cell in cells]
        for key, values in numbers.items():
            if values[0] is None:
                assert row["filter"] == "lstm"
                assert row[f"{key}_mean"] == row[f"{key}_spread"] == ""
                continue
            mean, spread = statistics.fmean(values), statistics.stdev(values)
            assert float(row[f"{key}_mean"]) == pytest.approx(mean, rel=1e-12)
            assert float(row[f"{key}_spread"]) == pytest.approx(spread, rel=1e-9, abs=1e-12)
            if key != "seconds":
                assert f"{mean:.2f} ± {spread:.2f}" in markdown
        bounds = [row["nees_low"], row["nees_high"]]
        from scipy.stats import chi2

        expected = [chi2.ppf(q, 6) / 6 for q in (0.025, 0.975)]  # 3 components, 2 test trajectories
        if row["filter"] == "lstm":
            assert bounds == ["", ""]
        else:
            assert [float(bound) for bound in bounds] == pytest.approx(expected, rel=1e-12)


def test_stay_baseline_has_the_error_of_the_start(finished: Path) -> None:
    """The hinge does not move: keeping a start 3 cm off it has an error of 3 cm, and keeping the truth has none."""
    with (finished / "table.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["filter"] != TRIVIAL]
    assert {row["start_offset"] for row in rows} == {"3cm,20deg", ""}
    for row in rows:
        expected = 3.0 if row["start_offset"] else 0.0
        assert float(row["position_cm_stay"]) == pytest.approx(expected, abs=1e-3)
    tables = (finished / "table.md").read_text().split("## ")[1:]
    assert [table.split("\n")[0] for table in tables] == [
        "door, start offset 3cm,20deg",
        "door, start at the truth",
    ], "offset starts do not come first"
    assert "| 3.00 |" in tables[0]


@pytest.mark.usefixtures("no_figures")
def test_cell_of_an_earlier_version_is_shown_and_only_evaluated(data: Path, finished: Path, tmp_path: Path) -> None:
    """Earlier versions had no offset starts, no baselines and no 95 % blackout."""
    folder, old = tmp_path / "study", cell(data)
    shutil.copytree(finished, folder)
    complete = document(folder, str(old))
    earlier = document(folder, str(old))
    del earlier[OFFSET], earlier[TRUTH]["0.95"]
    for metrics in earlier[TRUTH].values():
        del metrics["fused"]["baselines"], metrics["fused"]["rmse_from_step_0"]
    old.path(folder).write_text(json.dumps(earlier))
    rows = rows_of({old: old.document(folder)})
    assert [(row.filter, row.start, row.blackout) for row in rows] == [
        *((old.filter, "", blackout) for blackout in BLACKOUTS),
        (TRIVIAL, "", None),
    ]
    assert not any(row.baselines or row.from_step_0 for row in rows)
    assert "stay" not in to_markdown(rows)
    assert old.finished(folder) is None
    before = old.path(folder, ".safetensors").stat().st_mtime_ns
    assert run_cell(old, folder) == complete
    assert old.path(folder, ".safetensors").stat().st_mtime_ns == before, "the cell was trained again"


def test_trivial_predictor_returns_the_training_mean(finished: Path, data: Path) -> None:
    with open_dataset(data) as dataset:
        mean = np.concatenate([e.states for e in dataset if e.split == "train"]).mean(0, dtype=float)
        error = np.concatenate([e.states[30:] for e in dataset if e.split == "test"]) - mean
    rms = np.sqrt((error**2).mean(0))
    trivial = document(finished, NAMES[0])["trivial"]
    assert trivial["hinge_x_cm"] == pytest.approx(100 * rms[0], rel=1e-5)
    assert trivial["angle_deg"] == pytest.approx(np.degrees(rms[2]), rel=1e-5)
    assert f"| {TRIVIAL} | any |  | {100 * rms[0]:.2f} |" in (finished / "table.md").read_text()


def test_figure_contains_filters_and_quantities(finished: Path) -> None:
    image = Image.open(finished / "results.png").convert("RGB")
    assert image.width == round(300 * 7.16)
    assert len(image.getcolors(image.width * image.height)) > 20
    assert (finished / "results.pdf").read_bytes().startswith(b"%PDF")
    text = (finished / "results.svg").read_text()
    for word in ("door: hinge", "door: angle", "RMSE (cm)", "RMSE (deg)", "image blackout", "40%", *FILTERS, TRIVIAL):
        assert word in text, word


def cell(data: Path, name: str = "haptics-ekf", **changes: Any) -> Cell:
    with open_dataset(data) as dataset:
        data_hash = dataset.hash
    values = {"seed": 0, "preset": "smoke", "source": "door", "data": data, "data_hash": data_hash} | changes
    return Cell("door", name, **values)


def test_cells_with_other_inputs_are_not_finished(finished: Path, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cell(data).finished(finished) is not None
    assert cell(data, preset="cpu").finished(finished) is None
    assert cell(data, data_hash="0" * 64).finished(finished) is None
    monkeypatch.setattr(study, "versions", lambda: {"torch": "0.1"})
    assert cell(data).finished(finished) is None


def test_cell_with_a_changed_checkpoint_is_not_finished(data: Path, finished: Path, tmp_path: Path) -> None:
    first, folder = cell(data), shutil.copytree(finished, tmp_path / "study")
    path = first.path(folder, ".safetensors")
    path.write_bytes(path.read_bytes()[:-1] + bytes([path.read_bytes()[-1] ^ 1]))
    assert first.finished(folder) is None


@pytest.mark.long
@pytest.mark.usefixtures("no_figures")
def test_failed_cell_is_reported_and_the_others_run(
    data: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder with the name of one cell's checkpoint prevents writing it."""
    shutil.copytree(finished, tmp_path / "study")
    obstacle = tmp_path / "study" / "cells" / "door" / "lstm" / "seed0.safetensors"
    obstacle.unlink()
    obstacle.mkdir()
    assert run(arguments(data, tmp_path / "study")) == 2
    out, err = capsys.readouterr()
    assert "error: 1 of 4 cells failed; the first: door/lstm/seed0: " in err
    assert "3 of 4 cells finished" in out
    assert "| lstm | 0% | 1 of 2, 1 failed |" in out
    states = json.loads((tmp_path / "study" / "study.json").read_text())["cells"]
    assert "Is a directory" in states.pop("door/lstm/seed0")
    assert set(states.values()) == {"finished"}
    # Only the failed cell runs again.
    obstacle.rmdir()
    assert run(arguments(data, tmp_path / "study")) == 0


@pytest.mark.usefixtures("no_figures")
def test_unusable_data_is_invalid_input(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damaged = shutil.copy(data, tmp_path / "nan.h5")
    with h5py.File(damaged, "r+") as file:
        states = file["trajectory0/states"]
        states[...] = states[()] * np.nan
    options = f"--task door --filter lstm --data door={damaged} --preset smoke --seeds 1"
    assert run(["study", *options.split(), "-o", str(tmp_path / "study")]) == 2
    assert "first: door/lstm/seed0: " + str(damaged) in capsys.readouterr().err


@pytest.mark.long
def test_cell_locked_by_another_process_is_skipped(data: Path, tmp_path: Path) -> None:
    locked = cell(data, "lstm")
    lock = locked.path(tmp_path, "").with_name(".seed0.lock")
    lock.parent.mkdir(parents=True)
    code = "import fcntl, sys; f = open(sys.argv[1], 'w'); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); input()"
    words = [sys.executable, "-c", code, str(lock)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        assert run_cell(locked, tmp_path, wait=False) is None
        assert rows_of({locked: locked.document(tmp_path)})[0].seeds == 0
        other.kill()
    # The lock ends with its process.
    assert run_cell(locked, tmp_path, wait=False) == locked.finished(tmp_path) is not None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--preset fast", "preset 'fast' does not exist. Available: cpu, full, smoke"),
        ("--engine slurm", "'slurm' is not one of 'local', 'ray'"),
        ("--task dor", "task 'dor' does not exist"),
        ("--task door --filter lstmm", "filter 'lstmm' does not exist. Did you mean lstm? Available: crossmodal-ekf"),
        ("--seeds 0", "'0' is not an integer of at least 1"),
        ("--data door.h5", "--data 'door.h5' is not TASK=FILE"),
        ("--task door --data push=a.h5", "--data 'push=a.h5' is for task 'push', but the study is of door"),
        ("--data door=none.h5", "none.h5 does not exist"),
        ("--data door=train.h5", "train.h5 has episodes of train; a study needs train and test or val"),
    ],
)
def test_invalid_options_are_rejected(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with open_dataset(sample_path("door")) as dataset:
        write_dataset("train.h5", find_task("door"), [dataset[0]])
    assert run(["study", *words.split(), "-o", "new"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not Path("new").exists()


def logged(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """(step, value) by tag of TensorBoard's event files: length, checksum, protobuf, checksum."""
    from tensorboardX.proto.event_pb2 import Event

    values: dict[str, list[tuple[int, float]]] = {}
    for path in sorted(folder.glob("events.out.tfevents.*")):
        data = path.read_bytes()
        while data:
            (size,) = struct.unpack("<Q", data[:8])
            event = Event.FromString(data[12 : 12 + size])
            for value in event.summary.value:
                values.setdefault(value.tag, []).append((event.step, value.simple_value))
            data = data[16 + size :]
    return values


@pytest.mark.long
def test_killed_training_resumes_and_logs_losses(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def words(output: Path, *more: str) -> list[str]:
        options = ["--filter", "crossmodal-ekf", "--data", str(data), "--preset", "smoke", "--seed", "3"]
        return ["train", "door", *options, *more, "-o", str(output)]

    pytest.importorskip("tensorboardX")
    first, resumed = tmp_path / "first.safetensors", tmp_path / "resumed.safetensors"
    assert run(words(first, "--log", str(tmp_path / "log"))) == 0
    assert "resuming" not in capsys.readouterr().err
    partial = tmp_path / "resumed.safetensors.partial"
    kill_when(words(resumed), partial.exists)
    assert not resumed.exists()
    assert run(words(resumed)) == 0
    assert re.search(r"resuming after stage '.+', from resumed\.safetensors\.partial", capsys.readouterr().err)
    assert not partial.exists()
    assert without_seconds(first) == without_seconds(resumed)

    losses = logged(tmp_path / "log")
    stages = {tag.rsplit("/", 1)[0] for tag in losses}
    assert {"dynamics_8_steps", "haptics_model", "image_only", "weights", "end_to_end_4_steps"} <= stages
    for stage in stages:
        assert losses[f"{stage}/validation"], stage
        assert all(np.isfinite(value) for _, value in losses[f"{stage}/training"])
    assert [step for step, _ in losses["haptics_model/training"]] == [1, 2]


@pytest.mark.long
def test_cells_on_a_ray_cluster(data: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="pip install 'beliefscope[ray]'")
    assert os.environ.get("RAY_ADDRESS") is None
    cells = [cell(data, "haptics-ekf"), cell(data, "lstm", data_hash="0" * 64)]
    answers = dict(run_cells(cells, tmp_path, "ray", 1))
    assert answers[cells[0]] == cells[0].finished(tmp_path)
    assert answers[cells[0]]["metrics"] == document(finished, NAMES[0])["metrics"]
    assert "was changed while the study ran" in answers[cells[1]]["error"]

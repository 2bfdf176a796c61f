"""Sweeps: rows agree with the evaluation and with traces, and depend on the inputs only."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.external.load import load_external
from beliefscope.inspect.sweep import Inputs, describe_checkpoint, summary
from beliefscope.inspect.trace import trace
from beliefscope.recordings.experiments import Experiments
from beliefscope.recordings.sweep_table import RESULTS, TABLES, is_finished, replaced_results, run_sweep, write_tables

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]
FILTERS = ("crossmodal-ekf", "image-pf")
PARTICLES, EPISODES, BLOCK = 40, 5, 2


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """Two filters of the door over five short episodes, clean and with blackouts."""
    folder = tmp_path_factory.mktemp("inputs")
    with open_dataset(sample_path("door")) as sample:
        write_dataset(folder / "door.h5", sample.task, [sample[i] for i in sample.held_out()[:EPISODES]])
    for name in FILTERS:
        shutil.copyfile(pretrained_path("door", name), folder / f"{name}.safetensors")
    (folder / f"{FILTERS[0]}.json").write_text('{"run": "https://tracker.example/7", "lr": 0.001}')
    checkpoints = tuple(folder / f"{name}.safetensors" for name in FILTERS)
    return Inputs(checkpoints, (folder / "door.h5",), ("", "blackout=0.4"), (0,), PARTICLES)


@pytest.fixture(scope="module")
def sweep(inputs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweep")
    reports: list[tuple[int, int]] = []
    table = run_sweep(inputs.cells(BLOCK), folder, progress=lambda done, total: reports.append((done, total)))
    assert reports[0] == (0, 20)
    assert reports[-1] == (20, 20)
    assert len(table) == len(pq.read_table(folder / f"{RESULTS}.parquet"))
    return folder


@pytest.mark.long
def test_pooled_results_equal_the_evaluation(inputs: Inputs, sweep: Path) -> None:
    overview = Experiments([sweep]).overview().to_pylist()
    assert len(overview) == 4
    with open_dataset(inputs.data[0]) as data:
        expected = evaluate(load_checkpoint(inputs.checkpoints[0]).filter, list(data))
    (row,) = [row for row in overview if row["name"] == FILTERS[0] and row["faults"] == ""]
    # The evaluation runs all episodes in one batch of float32; the floors of the covariance are the same.
    assert row["error"] == pytest.approx(expected.rmse["position_cm"], rel=1e-4)
    assert row["nees"] == pytest.approx(expected.nees, rel=1e-3)
    assert row["coverage95"] == pytest.approx(expected.coverage95, abs=2e-3)
    assert (row["unit"], row["episodes"]) == ("cm", EPISODES)
    training = json.loads(row["training"])
    assert training["blackouts"] == [0.0, 0.4, 0.8]
    assert (len(training["data"]), training["finetuned"]) == (64, None)
    assert Experiments([sweep]).components() == ["hinge_x_cm", "hinge_y_cm", "angle_deg"]
    for key in ("hinge_x_cm", "angle_deg"):
        assert row[key] == pytest.approx(expected.rmse[key], rel=1e-4)
    assert row["nll"] == pytest.approx(expected.nll, rel=1e-3)


def test_faults_after_all_steps_are_refused(inputs: Inputs) -> None:
    with pytest.raises(BadInput, match="starts after the last step, 99"):
        replace(inputs, faults=("", "blackout:from=100")).cells(BLOCK)


def test_phases_partition_the_steps(sweep: Path) -> None:
    steps = Experiments([sweep]).query(
        "SELECT phase, sum(steps) AS steps FROM results WHERE faults = '' GROUP BY phase"
    )
    by_phase = dict(zip(steps["phase"].to_pylist(), steps["steps"].to_pylist(), strict=True))
    assert by_phase["contact"] + by_phase["free motion"] == by_phase["all"]


def test_representations(sweep: Path) -> None:
    table, results = Experiments([sweep]), pq.read_table(sweep / f"{RESULTS}.parquet")
    size = f"{results.num_rows} rows of {results.num_columns} columns"
    assert repr(table) == f"<Experiments: {size}, checkpoints: 2, data sets: 1, in {sweep}>"
    html = table._repr_html_()
    assert html.count("<tr>") == 1 + len(table.overview())
    assert "image-pf" in html
    assert table.overview()["checkpoint"][0].as_py() not in html


def test_a_row_leads_to_its_trace(sweep: Path) -> None:
    experiments = Experiments([sweep])
    checkpoint = load_checkpoint(pretrained_path("door", "image-pf")).hash
    rows = experiments.query(
        "SELECT * FROM results WHERE checkpoint = ? AND episode = 3 AND faults <> '' ORDER BY phase", [checkpoint]
    ).to_pylist()
    again = sorted(summary(experiments.trace(rows[0])), key=lambda row: row["phase"])
    assert [row["phase"] for row in again] == [row["phase"] for row in rows]
    for row, stored in zip(again, rows, strict=True):
        np.testing.assert_equal({key: stored[key] for key in row}, row)  # particle filters run one by one: equal bits


def test_results_do_not_depend_on_processes_and_interruptions(inputs: Inputs, sweep: Path, tmp_path: Path) -> None:
    expected = (sweep / f"{RESULTS}.parquet").read_bytes()
    cells = inputs.cells(BLOCK)
    run_sweep(cells, tmp_path, workers=2)
    assert (tmp_path / f"{RESULTS}.parquet").read_bytes() == expected
    files = sorted(tmp_path.glob("cells/*/*.parquet"))
    assert len(files) == len(cells) == 12
    files[0].unlink()
    files[1].write_bytes(files[1].read_bytes()[:-30])  # as a disk may leave it after a power failure
    files[2].write_bytes(files[3].read_bytes())
    assert sum(is_finished(cell, tmp_path) for cell in cells) == 9
    run_sweep(cells, tmp_path)
    assert (tmp_path / f"{RESULTS}.parquet").read_bytes() == expected


@pytest.mark.long
def test_a_killed_sweep_resumes(inputs: Inputs, sweep: Path, tmp_path: Path) -> None:
    words = ["sweep", "--block", str(BLOCK), "--particles", str(PARTICLES), "-o", str(tmp_path / "sweep")]
    words += [word for path in inputs.checkpoints for word in ("--checkpoints", str(path))]
    words += ["--data", str(inputs.data[0]), "--faults", "", "--faults", "blackout=0.4", "--workers", "2"]
    process = subprocess.Popen([sys.executable, "-m", "beliefscope", *words], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("sweep/cells/*/*.parquet")):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert not (tmp_path / "sweep" / f"{RESULTS}.parquet").exists()
    subprocess.run([sys.executable, "-m", "beliefscope", *words], check=True, capture_output=True, timeout=120)
    assert (tmp_path / "sweep" / f"{RESULTS}.parquet").read_bytes() == (sweep / f"{RESULTS}.parquet").read_bytes()


def test_provenance_of_checkpoints(sweep: Path) -> None:
    rows = Experiments([sweep]).query("SELECT name, provenance->>'run' AS run, task FROM checkpoints ORDER BY name")
    assert rows.to_pylist() == [
        {"name": "crossmodal-ekf", "run": "https://tracker.example/7", "task": "door"},
        {"name": "image-pf", "run": None, "task": "door"},
    ]


@pytest.mark.long
def test_external_filters_run_beside_checkpoints(inputs: Inputs, tmp_path: Path, run: Run) -> None:
    """Their errors are those of the evaluation. Code that a table names is not executed."""
    external = "examples/04_own_filter.py:build"
    options = ("--checkpoints", external, "--checkpoints", str(inputs.checkpoints[0]), "--data", str(inputs.data[0]))
    code, out, _ = run("sweep", *options, "--workers", 2, "-o", tmp_path / "sweep", "--json", "-")
    assert code == 0
    rows = {row["name"]: row for row in json.loads(out)["overview"]}
    with open_dataset(inputs.data[0]) as data:
        filter_ = load_external(external, data.task)
        metrics = evaluate(filter_, [data[i] for i in range(EPISODES)])
    assert set(rows) == {filter_.name, FILTERS[0]}
    own = rows[filter_.name]
    assert own["error"] == pytest.approx(metrics.rmse["position_cm"], rel=1e-5)
    assert (own["checkpoint"], own["provenance"]) == (filter_.hash, "{}")
    tables = Experiments([tmp_path / "sweep"])
    (row,) = tables.query("SELECT * FROM results WHERE checkpoint = ? LIMIT 1", [filter_.hash]).to_pylist()
    with pytest.raises(BadInput, match=r"04_own_filter\.py:build is an external filter, .* serve --filter /"):
        tables.trace(row)


def test_provenance_is_standard_json(tmp_path: Path) -> None:
    path = Path(shutil.copy(pretrained_path("door", "image-ekf"), tmp_path))
    path.with_suffix(".json").write_text('{"loss": NaN, "best": {"loss": -Infinity, "rate": 1e999}, "lr": 1e-3}')
    provenance = describe_checkpoint(path)["provenance"]
    assert read_json(provenance) == {"loss": None, "best": {"loss": None, "rate": None}, "lr": 1e-3}


def test_queries_find_any_text_of_the_provenance(tmp_path: Path) -> None:
    provenance = {"operator": "Müller", "broken": "\ud800", "path": "C:\\runs"}
    path = Path(shutil.copy(pretrained_path("door", "image-ekf"), tmp_path / "a.safetensors"))
    path.with_suffix(".json").write_text(json.dumps(provenance))
    row = describe_checkpoint(path)
    assert "Müller" in row["provenance"]
    assert pa.array([row["provenance"]]).to_pylist() == [row["provenance"]], "valid UTF-8"
    assert json.loads(row["provenance"]) == provenance


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT * FROM read_csv('{file}')",
        "COPY results TO '{folder}/out.csv'",
        "SET enable_external_access=true",
        "ATTACH '{folder}/new.db'",
        "INSTALL httpfs",
        "SELECT 1; SELECT 2",
    ],
)
def test_queries_cannot_reach_other_files(sweep: Path, tmp_path: Path, sql: str) -> None:
    (tmp_path / "secret.csv").write_text("a\n1\n")
    experiments = Experiments([sweep])
    with pytest.raises(BadInput):
        experiments.query(sql.format(file=tmp_path / "secret.csv", folder=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["secret.csv"]
    assert len(experiments.query("SELECT * FROM results"))


def test_commands(run: Run, sweep: Path, tmp_path: Path) -> None:
    code, out, _ = run("experiments --phase contact --sort nees --json -", sweep)
    document = json.loads(out)
    nees = [row["nees"] for row in document["rows"]]
    assert (code, document["count"]) == (0, 4)
    assert nees == sorted(nees, reverse=True)
    code, out, _ = run("experiments --top 1 -o", tmp_path / "all.csv", sweep)
    assert code == 0
    assert "3 more rows: --top 4" in out
    assert "NEES/n" in out  # stored as nees, over n
    assert "Not in this table: 2 entries of the provenance (lr, run)." in out
    query = out.rpartition("--sql ")[2]
    code, out, _ = run(f"experiments --sql {query.strip()} --json -", sweep)
    assert code == 0
    assert {row["value"] for row in json.loads(out)["rows"]} == {"0.001", None}
    assert len((tmp_path / "all.csv").read_text().splitlines()) == 5
    for line, message in {
        "--sql 'SELECT * FROM nowhere'": "nowhere",
        "--sql ' '": "has no result",
        "--sql 'SELECT 1; DROP VIEW results'": "has several statements, expected one SELECT",
        "--phase asleep": "no steps in phase 'asleep'. Available: all, blackout, contact, free motion",
        "--sort speed": "column 'speed' of the overview does not exist",
    }.items():
        code, _, error = run(f"experiments {line}", sweep)
        assert code == 2
        assert message in error
        assert error.count("\n") == 1
    assert "has no results of a sweep" in run("experiments", tmp_path)[2]


def test_results_that_another_command_replaces_are_announced(
    inputs: Inputs, sweep: Path, run: Run, tmp_path: Path
) -> None:
    assert replaced_results(inputs.cells(BLOCK), sweep) == 0
    assert replaced_results(inputs.cells(BLOCK), tmp_path) == 0
    folder = shutil.copytree(sweep, tmp_path / "sweep")
    options = f"--particles {PARTICLES} --block {BLOCK} --faults '' --data {inputs.data[0]} -o {folder}"
    _, _, notes = run(f"sweep --checkpoints {inputs.checkpoints[0]} {options}")
    assert "will have the results of this command only, and lose 3 others; to keep them, stop" in notes
    _, _, notes = run(f"sweep --checkpoints {inputs.checkpoints[0]} {options}")
    assert "Warning" not in notes


@pytest.mark.parametrize("table", TABLES)
def test_a_missing_table_is_named_with_the_next_step(sweep: Path, run: Run, tmp_path: Path, table: str) -> None:
    """Before the tables are opened, and when one is deleted afterwards."""
    folder = Path(shutil.copytree(sweep, tmp_path / "sweep"))
    tables = Experiments([folder])
    (folder / f"{table}.parquet").unlink()
    command = f"beliefscope sweep --checkpoints ... -o {folder}\n"
    for line in ("experiments", "serve --port 0 --sweep"):
        code, _, error = run(line, folder)
        assert code == 2
        assert f"{table}.parquet is missing; " in error
        assert error.endswith(command)
    with pytest.raises(BadInput, match=rf"{table}\.parquet is missing"):
        tables.query(f"SELECT * FROM {table}")
    if table == RESULTS:
        with pytest.raises(BadInput, match=r"results\.parquet is missing"):
            tables.phases()


def test_a_damaged_table_is_named_with_the_next_step(sweep: Path, run: Run, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(sweep, tmp_path / "sweep"))
    (folder / "results.parquet").write_text("x")
    code, _, error = run("experiments", folder)
    assert code == 2
    assert "results.parquet" in error
    assert "delete this file and run the sweep again" in error


def test_a_deleted_file_of_a_cell_or_checkpoint_is_named(inputs: Inputs, sweep: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(sweep, tmp_path / "sweep"))
    file = next((folder / "cells").glob("*/*.parquet"))
    file.unlink()
    with pytest.raises(BadInput, match=f"{file.name} was deleted while the sweep ran; run the same command again"):
        write_tables(inputs.cells(BLOCK), folder)
    checkpoint = Path(shutil.copy(inputs.checkpoints[0], tmp_path / "moved.safetensors"))
    run_sweep(replace(inputs, checkpoints=(checkpoint,), faults=("",)).cells(BLOCK), tmp_path / "other")
    checkpoint.unlink()
    with pytest.raises(BadInput, match=r"moved\.safetensors' was deleted or moved after the sweep"):
        Experiments([tmp_path / "other"]).path(
            "checkpoints", "checkpoint", describe_checkpoint(checkpoint)["checkpoint"]
        )


def test_unusable_inputs(inputs: Inputs, run: Run, tmp_path: Path) -> None:
    code, _, error = run(f"sweep --checkpoints {tmp_path}/*.safetensors -o {tmp_path / 'sweep'}")
    assert (code, "no checkpoint (.safetensors) matches" in error) == (2, True)
    push = pretrained_path("push", "image-ekf")
    code, _, error = run(f"sweep --checkpoints {push} --data {inputs.data[0]} -o {tmp_path / 'sweep'}")
    assert (code, "fit no checkpoint; their tasks are push" in error) == (2, True)
    assert not (tmp_path / "sweep").exists()


def test_rows_of_several_sweeps_are_counted_once(sweep: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(sweep, tmp_path / "copy"))
    counts = ["name", "faults", "episodes", "steps", "worst"]
    once = Experiments([sweep]).overview().select(counts)
    assert Experiments([sweep, sweep]).overview().select(counts).equals(once)
    assert Experiments([sweep, copy]).overview().select(counts).equals(once)


def test_copies_of_a_checkpoint_run_once(inputs: Inputs, tmp_path: Path) -> None:
    (path, *_) = inputs.checkpoints
    copy = Path(shutil.copy(path, tmp_path / "copy.safetensors"))
    assert replace(inputs, checkpoints=(path, copy)).cells() == replace(inputs, checkpoints=(path,)).cells()
    copy.with_suffix(".json").write_text("[1]")
    with pytest.raises(BadInput, match="expected a JSON object"):
        replace(inputs, checkpoints=(path, copy)).cells()


def test_values_of_a_database_are_json(run: Run, sweep: Path) -> None:
    sql = "SELECT sum(steps) AS total, DATE '2026-01-31' AS day, [1, 2] AS list FROM results"
    code, out, _ = run("experiments --json - --sql", sql, sweep)
    (row,) = json.loads(out)["rows"]
    assert code == 0
    assert row["total"] == sum(Experiments([sweep]).query("SELECT steps FROM results")["steps"].to_pylist())
    assert (row["day"], row["list"]) == ("2026-01-31", [1, 2])
    code, _, error = run("experiments --sql", "SELECT 1 AS a, 2 AS a", sweep)
    assert code == 2
    assert "several columns are named a" in error


def test_low_coverage_is_the_worst(sweep: Path) -> None:
    coverage = Experiments([sweep]).overview(sort="coverage95")["coverage95"].to_pylist()
    assert coverage == sorted(coverage)


def test_sweeps_of_different_tasks_are_joined(sweep: Path, tmp_path: Path) -> None:
    with open_dataset(sample_path("push")) as sample:
        write_dataset(tmp_path / "push.h5", sample.task, [sample[sample.held_out()[0]]])
    run_sweep(Inputs((pretrained_path("push", "image-ekf"),), (tmp_path / "push.h5",)).cells(), tmp_path / "push")
    rows = Experiments([sweep, tmp_path / "push"]).query(
        "SELECT task, max(hinge_x_cm) AS hinge, max(x_cm) AS puck FROM results GROUP BY task ORDER BY task"
    )
    assert isinstance(rows, pa.Table)
    (door, push) = rows.to_pylist()
    assert (door["puck"], push["hinge"]) == (None, None)
    assert door["hinge"] > 0.0 < push["puck"]


def test_rows_have_the_time_of_the_worst_step() -> None:
    filter_ = load_checkpoint(pretrained_path("door", "image-ekf"))
    with open_dataset(sample_path("door")) as sample:
        episode = sample[0]
    times = np.linspace(0.0, 3.0, len(episode)) ** 2
    timed = list(summary(trace(filter_, replace(episode, time=times))))
    assert [row["worst_time"] for row in timed] == [times[row["worst_step"]] for row in timed]
    assert {row["worst_time"] for row in summary(trace(filter_, episode))} == {None}


def test_results_have_the_time_of_the_worst_step(sweep: Path, tmp_path: Path) -> None:
    """Of an episode with timestamps, and not of one without, nor in the results of earlier versions."""
    with open_dataset(sample_path("door")) as sample:
        episode = sample[0]
        times = np.linspace(0.0, 3.0, len(episode)) ** 2
        episodes = [replace(episode, time=times), sample[1]]
        write_dataset(tmp_path / "timed.h5", sample.task, episodes)
    folder = tmp_path / "timed"
    filters, data = (pretrained_path("door", "image-ekf"),), (tmp_path / "timed.h5",)
    run_sweep(Inputs(filters, data, all_episodes=True).cells(), folder)
    experiments = Experiments([folder])
    (row,) = experiments.overview().to_pylist()
    by_episode = experiments.episodes(row["checkpoint"], row["data"]).to_pylist()
    expected = {r["episode"]: times[r["worst_step"]] if r["episode"] == 0 else None for r in by_episode}
    assert {r["episode"]: r["worst_time"] for r in by_episode} == expected
    assert row["worst_time"] == expected[row["worst_episode"]]

    results = pq.read_table(folder / "results.parquet")
    pq.write_table(results.drop_columns(["worst_time"]), folder / "results.parquet")
    (earlier,) = Experiments([folder]).overview().to_pylist()
    assert earlier == row | {"worst_time": None}

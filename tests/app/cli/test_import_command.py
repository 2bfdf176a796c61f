"""``beliefscope import``: the split of the episodes of a log."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from beliefscope.datasets.store import open_dataset
from beliefscope.inspect.trace import load_trace

Run = Callable[..., tuple[int, str, str]]

STEPS = 40

MAP = """
task = "car"
time = "t"
episode = "run"
control = "t"
[state]
x = "x"
y = "y"
[sensors]
gps = ["x", "y"]
[estimate]
mean = ["x", "y"]
"""


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log of three episodes; its map is beside it."""
    t = np.tile(0.1 * np.arange(STEPS), 3)
    run = np.repeat(np.arange(3), STEPS)
    np.savez(tmp_path / "log.npz", t=t, run=run, x=np.sin(t + run), y=np.cos(t + run))
    (tmp_path / "map.toml").write_text(MAP)
    return tmp_path / "log.npz"


@pytest.mark.parametrize(("option", "expected"), [("", "test"), ("--split train", "train"), ("--split val", "val")])
def test_the_episodes_are_in_the_selected_split(run: Run, log: Path, option: str, expected: str) -> None:
    inputs = (log, "--map", log.with_name("map.toml"), "-o")
    assert run(f"import {option}", *inputs, log.with_name("data.h5"))[0] == 0
    with open_dataset(log.with_name("data.h5")) as data:
        assert [episode.split for episode in data] == [expected] * 3
    assert run(f"import {option} --episode 1", *inputs, log.with_name("run.trace"))[0] == 0
    assert load_trace(log.with_name("run.trace")).episode.split == expected


def test_a_folder_gets_a_trace_of_each_episode(run: Run, log: Path) -> None:
    inputs = (log, "--map", log.with_name("map.toml"), "-o")
    code, output, _ = run("import", *inputs, log.with_name("traces"))
    traces = [log.with_name("traces") / f"{log.stem}-{i}.trace" for i in range(3)]
    assert code == 0
    assert len(output.splitlines()) == 3
    assert [load_trace(path).episode_index for path in traces] == [0, 1, 2]
    assert "one of 3 episodes (-o DIR: all)" in run("import", *inputs, log.with_name("run.trace"))[1]


@pytest.mark.parametrize(("output", "suffix"), [("traces", ".trace"), ("live", ".live")])
def test_the_traces_of_a_folder_of_tables_have_the_names_of_its_files(
    run: Run, log: Path, output: str, suffix: str
) -> None:
    names = ["run_2", "mon 2024 (first)", "n" * 240]
    log.with_name("map.toml").write_text(MAP.replace('episode = "run"\n', ""))
    for day, files in (("days", names), ("others", ["run_2"])):
        log.with_name(day).mkdir()
        for name in files:
            np.savez(log.with_name(day) / f"{name}.npz", **{c: v[:STEPS] for c, v in np.load(log).items()})
    rest = ("--map", log.with_name("map.toml"), "-o", log.with_name(output))
    code, _, error = run("import", log.with_name("days"), *rest)
    assert code == 0, error
    assert {path.name for path in log.with_name(output).iterdir()} == {f"{name}{suffix}" for name in names}
    code, _, error = run("import", log.with_name("days"), log.with_name("others"), *rest)
    assert (code, error.startswith("error: several files have the name 'run_2'")) == (2, True)
    log.with_name("days").joinpath("run_2.npz").rename(log.with_name("days") / f"{'n' * 251}.npz")
    code, _, error = run("import", log.with_name("days"), *rest)
    assert code == 2
    assert "has a name of 25" in error


def test_a_data_set_is_converted_by_the_name_of_its_own_task(run: Run, log: Path) -> None:
    data, copy = log.with_name("data.h5"), log.with_name("copy.h5")
    assert run("import", log, "--map", log.with_name("map.toml"), "-o", data)[0] == 0
    code, _, error = run("convert car --data", data, "-o", copy)
    assert code == 0, error
    assert copy.read_bytes() == data.read_bytes()


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.filterwarnings("error:std")
@pytest.mark.parametrize(
    "name", [*(pytest.param(name, marks=pytest.mark.long) for name in ("unimodal-ekf", "unimodal-pf")), "lstm"]
)
def test_a_filter_is_trained_on_a_log_without_controls(run: Run, log: Path, name: str) -> None:
    data, checkpoint = log.with_name("data.h5"), log.with_name("filter.safetensors")
    log.with_name("map.toml").write_text(MAP.replace('control = "t"\n', ""))
    assert run("import --split train", log, "--map", log.with_name("map.toml"), "-o", data)[0] == 0
    code, _, error = run(f"train car --filter {name} --preset smoke", "--data", data, "-o", checkpoint)
    assert code == 0, error
    inputs = ("--filter", checkpoint, "--data", data)
    assert run("trace car --episode 0", *inputs, "-o", log.with_name("run.trace"))[0] == 0


@pytest.mark.slow
def test_a_filter_is_trained_on_an_imported_log(run: Run, log: Path) -> None:
    data = log.with_name("data.h5")
    for split in ("test", "train"):
        run(f"import --split {split}", log, "--map", log.with_name("map.toml"), "-o", data)
        line = "train car --filter unimodal-ekf --preset smoke"
        code, _, error = run(line, "--data", data, "-o", log.with_name("filter.safetensors"))
        if split == "test":
            assert code == 2
            assert "beliefscope import --split train" in error
    assert code == 0, error


def test_another_split_is_refused(run: Run, log: Path) -> None:
    output = log.with_name("data.h5")
    code, _, error = run("import --split validation", log, "--map", log.with_name("map.toml"), "-o", output)
    assert (code, error) == (2, "error: split 'validation' does not exist. Available: train, val, test, auto.\n")
    assert not output.exists()


def test_a_recording_has_a_split_already(run: Run, tmp_path: Path) -> None:
    code, _, error = run("import --split train", tmp_path / "run.rrd", "-o", tmp_path / "run.trace")
    assert code == 2
    assert error == "error: --split applies to logs: run.rrd is a recording, whose episode already has a split\n"


def test_several_logs_become_a_folder_of_traces_and_a_damaged_one_is_reported(run: Run, log: Path) -> None:
    second, damaged, output = log.with_name("second.npz"), log.with_name("damaged.npz"), log.with_name("traces")
    second.write_bytes(log.read_bytes())
    damaged.write_bytes(log.read_bytes()[:100])
    code, out, error = run("import --episode 0", log, damaged, second, "--map", log.with_name("map.toml"), "-o", output)
    assert code == 2
    assert [line.partition(" (")[0] for line in out.splitlines()] == [
        str(output / "log.trace"),
        str(output / "second.trace"),
        "2 of 3 files imported",
    ]
    assert error.startswith(f"error: {damaged}: damaged.npz ")
    assert error.count("\n") == 1
    assert {path.name for path in output.iterdir()} == {"log.trace", "second.trace"}
    assert load_trace(output / "second.trace").task.name == "car"
    code, out, _ = run("import --episode 0 --json -", log, damaged, "--map", log.with_name("map.toml"), "-o", output)
    first, other = json.loads(out)["files"]
    assert (code, first["path"], set(other)) == (2, str(output / "log.trace"), {"source", "error"})


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("run.trace", "2 files need a folder as output, not '{}/run.trace'"),
        (
            "traces",
            "several files have the name 'log': files need different names, without their suffixes, to become traces "
            "of one folder",
        ),
    ],
)
def test_several_files_need_a_folder_and_different_names(run: Run, log: Path, output: str, message: str) -> None:
    files = (log, log.with_suffix(".csv"))
    code, _, error = run("import", *files, "--map", log.with_name("map.toml"), "-o", log.with_name(output))
    assert (code, error) == (2, f"error: {message.format(log.parent)}\n")
    assert not log.with_name(output).exists()


def test_a_folder_of_logs_of_messages_becomes_a_folder_of_traces(run: Run, tmp_path: Path) -> None:
    writer = pytest.importorskip("mcap.writer")
    (tmp_path / "logs").mkdir()
    for name in ("run_2", "run_10"):
        with (tmp_path / "logs" / f"{name}.mcap").open("wb") as stream:
            log = writer.Writer(stream)
            log.start()
            channel = log.register_channel("/pose", "json", log.register_schema("any", "jsonschema", b"{}"))
            for step in range(STEPS):
                log.add_message(channel, step * 100_000_000, json.dumps({"x": step / 7, "y": 1.0}).encode(), 0)
            log.finish()
    text = 'dt = 0.1\n[state]\nx = "/pose.x"\n[sensors]\ngps = "/pose"\n[estimate]\nmean = ["/pose.x"]\n'
    (tmp_path / "map.toml").write_text(text)
    output = tmp_path / "traces" / "today"
    code, out, error = run("import", tmp_path / "logs", "--map", tmp_path / "map.toml", "-o", output)
    assert code == 0, error
    lines = [line.partition(" (")[0] for line in out.splitlines()]
    assert lines == [str(output / "run_2.trace"), str(output / "run_10.trace"), "2 of 2 files imported"]
    assert "[sensors]" in run("import --guess", tmp_path / "logs")[1]


def test_a_log_of_estimates_only_has_figures_and_diagnostics(run: Run, tmp_path: Path) -> None:
    """Without sensors, there are no filters of this project for its task."""
    x = np.sin(0.1 * np.arange(STEPS))
    rows = np.column_stack([x, x + 0.01, np.full(STEPS, 0.02)])
    np.savetxt(tmp_path / "bare.csv", rows, delimiter=",", header="x,x_hat,x_std", comments="")
    _, mapping, _ = run("import", tmp_path / "bare.csv", "--guess")
    (tmp_path / "map.toml").write_text(mapping)
    trace = tmp_path / "bare.trace"
    assert run("import", tmp_path / "bare.csv", "--map", tmp_path / "map.toml", "-o", trace)[0] == 0
    assert load_trace(trace).task.modalities == {}
    for line in (("inspect", trace), ("figure", "timeline", trace, "-o", tmp_path / "timeline.csv")):
        code, _, error = run(*line)
        assert code == 0, error

"""Logs as users damage them: one line that names the wrong value and what is expected, exit code 2, nothing written."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.inspect.trace import load_trace
from beliefscope.recordings.log_readers import tables

sys.path.insert(0, str(Path(__file__).parent))

from log_files import START, mcap_writer

STEPS = 30
TIME = 0.1 * np.arange(STEPS)

MAP = """
task = "car"
time = "t"
[state]
x = "x"
yaw = {column = "yaw", unit = "rad"}
[sensors]
gps = ["gx", "gy"]
"""

TOPICS = """
task = "car"
dt = 0.1
[state]
x = "/state.x"
y = "/state.y"
[sensors]
z = "/sensor.z"
"""

Run = Callable[..., tuple[int, str, str]]


def columns() -> dict[str, np.ndarray]:
    return {"t": TIME, "x": np.sin(TIME), "yaw": TIME, "gx": TIME + 0.01, "gy": TIME - 0.01}


def text(values: Mapping[str, Any] | None = None, separator: str = ",") -> str:
    """Columns as CSV."""
    values = values or columns()
    rows = zip(*values.values(), strict=True)
    return "\n".join(separator.join(map(str, row)) for row in [values.keys(), *rows]) + "\n"


def refused(run: Run, log: Path, mapping: str) -> str:
    """The error of an import."""
    (log.parent / "map.toml").write_text(mapping)
    files = set(log.parent.iterdir())
    code, out, error = run("import", log, "--map", log.parent / "map.toml", "-o", log.parent / "out.h5")
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert set(log.parent.iterdir()) == files
    return error


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (text().replace("2.0,", "", 1).encode(), "Row #22: Expected 5 columns, got 4"),
        (text().encode("utf-16"), "is UTF-16: expected a CSV file in UTF-8"),
        (text().replace("gx", "größe").encode("latin1"), "is not UTF-8, with the byte 0xf6 in line 1"),
        (text().replace("gy", "gx").encode(), "has 2 columns 'gx', expected unique names"),
        ("\n".join(text().splitlines()[:2]).encode(), "has one step per episode, expected two or more"),
    ],
    ids=["cells", "UTF-16", "Latin 1", "names", "row"],
)
def test_csv(run: Run, tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "log.csv").write_bytes(content)
    assert message in refused(run, tmp_path / "log.csv", MAP)


@pytest.mark.parametrize(
    "content",
    [
        text(separator=";"),
        text(separator=";").replace(".", ","),
        text(separator="\t").replace(".", ","),
        "\ufeff" + text(separator=";").replace(".", ",").replace("\n", "\r\n"),
    ],
    ids=["semicolons", "decimal commas", "tabs", "byte order mark"],
)
def test_separators_of_csv_files(tmp_path: Path, content: str) -> None:
    (tmp_path / "log.csv").write_text(content, newline="")
    values = tables.read(tmp_path / "log.csv", lambda _: True)
    for name, expected in columns().items():
        np.testing.assert_allclose(values[name], expected)


def test_units_of_times_are_converted_and_repeated_times_have_a_remedy(run: Run, tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", **columns() | {"t": 1_700_000_000_000_000_000 + np.arange(STEPS) * 50_000_000})
    mapping = MAP.replace('time = "t"', 'time = {column = "t", unit = "ns"}')
    (tmp_path / "map.toml").write_text(mapping)
    code, out, _ = run("import", tmp_path / "log.npz", "--map", tmp_path / "map.toml", "-o", tmp_path / "ns.h5")
    assert (code, "30 steps, 0.05 s each" in out) == (0, True)
    np.savez(tmp_path / "log.npz", **columns() | {"t": np.arange(STEPS) // 2})
    error = refused(run, tmp_path / "log.npz", MAP)
    assert "is 0 s at step 1, after 0 s; expected ascending times, counted from its first row; remove rows" in error
    error = refused(run, tmp_path / "log.npz", mapping.replace('"ns"', '"min"'))
    assert "unit 'min' of time does not exist. Available: s, ms, us, ns" in error


def test_spaces_around_the_names_of_columns_are_ignored(run: Run, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(text().replace("t,x,yaw", "t, x , yaw"))
    (tmp_path / "map.toml").write_text(MAP)
    code, out, _ = run("import", tmp_path / "log.csv", "--map", tmp_path / "map.toml", "-o", tmp_path / "out.h5")
    assert code == 0
    assert "1 episode (1 test) of car, 30 steps, 0.1 s each; x 0 to 0.9996 m; yaw 0 to 2.9 rad" in out


@pytest.mark.parametrize(
    ("change", "line", "message"),
    [
        ({"t": TIME[:-1]}, "", "time 't' has the shape (29,), expected one value in each of 30 rows"),
        ({"t": np.stack([TIME, TIME], 1)}, "", "time 't' has the shape (30, 2)"),
        ({"c": np.zeros(31)}, 'contact = "c"', "contact, column 'c', has the shape (31,)"),
        ({"run": np.zeros(29, int)}, 'episode = "run"', "the episode, column 'run', has the shape (29,)"),
        ({"run": np.arange(30)}, 'episode = "run"', "has one step per episode, expected two or more"),
        ({"x": TIME.astype(str)}, "", "numbers stored as text, such as '0.0' in row 0, expected numbers"),
    ],
)
def test_arrays(run: Run, tmp_path: Path, change: dict[str, np.ndarray], line: str, message: str) -> None:
    np.savez(tmp_path / "log.npz", **columns() | change)
    assert message in refused(run, tmp_path / "log.npz", f"{line}\n{MAP}")


def test_durations_and_decimals_of_parquet_are_numbers(run: Run, tmp_path: Path) -> None:
    from decimal import Decimal

    import pyarrow as pa
    from pyarrow import parquet

    durations = pa.array([100_000 * step for step in range(STEPS)], pa.duration("us"))
    decimals = pa.array([Decimal(step) / 4 for step in range(STEPS)])
    parquet.write_table(pa.table({**columns(), "t": durations, "x": decimals}), tmp_path / "log.parquet")
    (tmp_path / "map.toml").write_text(MAP)
    code, out, _ = run("import", tmp_path / "log.parquet", "--map", tmp_path / "map.toml", "-o", tmp_path / "out.h5")
    assert code == 0
    assert "0.1 s each; x 0 to 7.25 m" in out


@pytest.mark.parametrize(("unit", "symbol"), [("degrees", "deg"), ("Radians", "rad"), ("metres", "m")])
def test_names_of_units_have_symbols(run: Run, tmp_path: Path, unit: str, symbol: str) -> None:
    (tmp_path / "log.csv").write_text(text())
    error = refused(run, tmp_path / "log.csv", MAP.replace('"rad"', f'"{unit}"'))
    assert f"unit of state 'yaw' is '{unit}', expected '{symbol}'" in error


def write_topics(path: Path, x: Callable[[int], Any] = float, sensor_start: float = 0.0, step: float = 0.1) -> None:
    """MCAP with two topics. x: of a step. sensor_start: s after the state. step: s between messages."""
    with path.open("wb") as stream:
        writer = mcap_writer(stream, False)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        state, sensor = (writer.register_channel(topic, "json", schema) for topic in ("/state", "/sensor"))
        for index in range(STEPS):
            time = START + round(step * index * 1e9)
            writer.add_message(state, time, json.dumps({"x": x(index), "y": 0.5}).encode(), time)
            time += round(sensor_start * 1e9)
            writer.add_message(sensor, time, json.dumps({"z": [1.0, float(index)]}).encode(), time)
        writer.finish()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sensor_start": 100.0}, "do not overlap in time"),
        ({"sensor_start": -100.0}, "topic '/sensor' ends before '/state' begins: they do not overlap in time"),
        ({"step": 0.0}, "has one step of 0.1 s per episode, expected two or more"),
        ({"x": lambda index: 10**40 if index == 7 else 0}, "has neither numbers nor text, such as '1000000"),
    ],
)
def test_topics(run: Run, tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    write_topics(tmp_path / "log.mcap", **settings)
    assert message in refused(run, tmp_path / "log.mcap", TOPICS)


def test_mcap_files_without_topics(run: Run, tmp_path: Path) -> None:
    with (tmp_path / "log.mcap").open("wb") as stream:
        writer = mcap_writer(stream, False)
        writer.start()
        writer.finish()
    assert "the file has no topics" in refused(run, tmp_path / "log.mcap", TOPICS)
    (tmp_path / "log.mcap").write_bytes((tmp_path / "log.mcap").read_bytes()[:8])
    assert "not a complete MCAP file" in refused(run, tmp_path / "log.mcap", TOPICS)


@pytest.mark.slow
def test_estimates_of_a_log_have_a_recording_and_no_empty_figures(run: Run, tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", **columns(), episode=np.repeat([0, 1], STEPS // 2))
    (tmp_path / "map.toml").write_text(f'episode = "episode"\n{MAP}[estimate]\nmean = ["x", "yaw"]\n')
    for i in range(2):
        trace, recording = tmp_path / f"{i}.trace", tmp_path / f"{i}.rrd"
        source = (tmp_path / "log.npz", "--map", tmp_path / "map.toml", "--episode", i)
        assert run("import", *source, "-o", trace)[0] == 0
        assert run("export", trace, "-o", recording)[0] == 0
        assert run("import", recording, "-o", tmp_path / "same.trace")[0] == 0
        assert np.array_equal(load_trace(tmp_path / "same.trace").estimate_mean, load_trace(trace).estimate_mean)
    code, _, _ = run("inspect", tmp_path / "0.trace", tmp_path / "1.trace", "--figures", tmp_path / "figures")
    assert code == 0
    assert not (tmp_path / "figures" / "errors.svg").exists()

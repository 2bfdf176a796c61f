"""Logs of other programs: every format gives the same episodes and traces; wrong input gives one line."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet

from beliefscope.datasets import rotations
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.statistics.measures import errors, nees
from beliefscope.inspect.trace import load_trace, save_trace
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.columns import column, joined, read_columns
from beliefscope.recordings.log_readers.guess import guess_map
from beliefscope.recordings.log_readers.messages import Preview
from beliefscope.recordings.log_readers.read_log import read_log, recorded_trace

MAP = """
task = "vehicle"
time = "t"
episode = "run"
[state]
x = {column = "true_x", unit = "cm"}
y = {column = "true_y", unit = "cm"}
yaw = {column = "true_yaw", unit = "deg"}
[sensors]
gps = ["gps_x", "gps_y"]
[estimate]
filter = "mine"
mean = ["est_x", "est_y", "est_yaw"]
std = ["sd_x", "sd_y", "sd_yaw"]
"""


def table(steps: int = 20) -> dict[str, np.ndarray]:
    """Two episodes whose rows alternate, in cm and degrees."""
    rng = np.random.default_rng(0)
    names = [f"{kind}_{c}" for kind in ("true", "est", "sd") for c in ("x", "y", "yaw")] + ["gps_x", "gps_y"]
    columns = {name: rng.uniform(1.0, 9.0, 2 * steps) for name in names}
    return {"run": np.tile(["b", "a"], steps), "t": np.repeat(np.arange(steps), 2) * 0.05, **columns}


@pytest.fixture(params=[".npz", ".csv", ".parquet"])
def log(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path, columns = tmp_path / f"log{request.param}", table()
    if request.param == ".npz":
        np.savez(path, **columns)
    else:
        write = csv.write_csv if request.param == ".csv" else parquet.write_table
        write(pa.table(columns), path)
    return path


def map_file(folder: Path, text: str = MAP) -> Path:
    path = folder / "map.toml"
    path.write_text(text)
    return path


def test_every_format_gives_the_same_episodes_and_traces(log: Path, tmp_path: Path) -> None:
    columns, mapping, expected = read_columns(log), read_map(map_file(tmp_path)), table()
    episodes = read_log(columns, mapping, log.name)
    assert [e.provenance["episode"] for e in episodes] == ["b", "a"]
    first = episodes[0]
    assert (first.task.name, first.dt, len(first)) == ("vehicle", pytest.approx(0.05), 20)
    scale = np.array([0.01, 0.01, np.pi / 180.0])
    truth = np.stack([expected[f"true_{c}"][::2] for c in ("x", "y", "yaw")], axis=1) * scale
    np.testing.assert_allclose(first.states, truth, rtol=1e-6)
    np.testing.assert_allclose(first.observations["gps"][:, 1], expected["gps_y"][::2], rtol=1e-6)
    trace = recorded_trace(columns, mapping, episodes, 1, log.name)
    np.testing.assert_allclose(trace.estimate_mean[:, 2], np.radians(expected["est_yaw"][1::2]), rtol=1e-6)
    std = np.sqrt(np.diagonal(trace.estimate_covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(std[:, 0], 0.01 * expected["sd_x"][1::2], rtol=1e-6)
    save_trace(trace, tmp_path / "run.trace")
    stored = load_trace(tmp_path / "run.trace")
    assert (stored.filter, stored.kind, stored.task.name) == ("mine", "external", "vehicle")


def test_arrays_of_an_archive(tmp_path: Path) -> None:
    """An ensemble gives mean and sample covariance of its members; unknown states are NaN; images keep their bytes."""
    rng = np.random.default_rng(1)
    particles = rng.normal(size=(12, 50, 2))
    images = rng.integers(0, 256, (12, 8, 8), dtype=np.uint8)
    np.savez(tmp_path / "log.npz", truth=rng.normal(size=(12, 2)), members=particles, camera=images)
    text = 'dt = 0.1\n[state]\nx = "truth[1]"\ny = ""\n[sensors]\nimage = "camera"\n[estimate]\nparticles = "members"\n'
    columns, mapping = read_columns(tmp_path / "log.npz"), read_map(map_file(tmp_path, text))
    (episode,) = read_log(columns, mapping, "log.npz")
    assert np.isnan(episode.states[:, 1]).all()
    assert np.array_equal(episode.observations["image"], images)
    trace = recorded_trace(columns, mapping, [episode], 0, "log.npz")
    np.testing.assert_allclose(trace.estimate_mean, particles.mean(1), atol=1e-6)
    expected = np.stack([np.cov(members.T) for members in particles])
    np.testing.assert_allclose(trace.estimate_covariance, expected, atol=1e-5)


def test_modalities_group_sensors(tmp_path: Path) -> None:
    sensors = '[sensors]\nforce = ["gps_x", "gps_y"]\ntorque = "sd_x"\nspeed = "sd_y"\n'
    text = MAP.replace(
        '[sensors]\ngps = ["gps_x", "gps_y"]\n', f'{sensors}[modalities]\nhaptics = ["force", "torque"]\n'
    )
    episode = read_log(table(), read_map(map_file(tmp_path, text)), "log")[0]
    assert episode.task.modalities == {"speed": ("speed",), "haptics": ("force", "torque")}
    assert episode.task.observations == {"force": (2,), "torque": (1,), "speed": (1,)}


def test_covariates_define_groups(tmp_path: Path) -> None:
    text = MAP.replace(
        "[estimate]",
        """[covariates]
fix = "fix"
stage = "stage"
speed = {column = "gps_x", cuts = [3, 6], unit = "m/s"}
[estimate]""",
    )
    rng = np.random.default_rng(3)
    columns = table() | {"fix": np.tile([1.0, np.nan, 0.0, 1.0], 10), "stage": rng.choice(["reach", "lift"], 40)}
    episode = read_log(columns, read_map(map_file(tmp_path, text)), "log")[0]
    kinds = {name: c.kind for name, c in episode.task.covariates.items()}
    assert kinds == {"fix": "boolean", "stage": "categorical", "speed": "continuous"}
    groups = {n: m for name, c in episode.task.covariates.items() for n, m in c.masks(name, episode.covariate(name))}
    assert [*groups] == ["fix", "no fix", "lift", "reach", *(f"speed {t} m/s" for t in ("below 3", "3 to 6", "from 6"))]
    assert np.array_equal(groups["lift"], columns["stage"][::2] == "lift")
    assert np.array_equal(groups["fix"], columns["fix"][::2] == 1.0)
    assert np.array_equal(groups["speed from 6 m/s"], columns["gps_x"][::2] >= 6.0)


def test_a_guessed_map_is_valid(log: Path, tmp_path: Path) -> None:
    columns = read_columns(log)
    text = guess_map(Preview(columns), "my log")
    values = tomllib.loads(text)
    assert (values["task"], values["time"]) == ("my-log", "t")
    assert values["estimate"] == {"mean": ["est_x", "est_y", "est_yaw"], "std": ["sd_x", "sd_y", "sd_yaw"]}
    episodes = read_log({n: v[::2] for n, v in columns.items()}, read_map(map_file(tmp_path, text)), "log")
    assert len(episodes) == 1


@pytest.mark.parametrize(("name", "unit"), [("yaw_deg", "deg"), ("yaw_rad", "rad"), ("lift_mm", "mm"), ("vx", "m/s")])
def test_a_guessed_map_has_the_units_of_the_names(name: str, unit: str) -> None:
    columns = {key: np.arange(5.0) for key in ("t", f"true_{name}", "gps_x")}
    assert f'{{column = "true_{name}", unit = "{unit}"}}' in guess_map(Preview(columns), "drive")


def test_a_guessed_map_has_names_units_and_sensors(tmp_path: Path) -> None:
    t = 0.1 * np.arange(80.0)
    names = ("true_x", "true_y", "true_vx", "true_yaw", "gps_x", "gps_y", "wheel")
    columns = {"t": t} | {name: (i + 1.0) * t for i, name in enumerate(names)}
    text = guess_map(Preview(columns), "drive")
    values = tomllib.loads(text)
    assert values["state"] == {
        "x": "true_x",
        "y": "true_y",
        "vx": {"column": "true_vx", "unit": "m/s"},
        "yaw": {"column": "true_yaw", "unit": "deg"},
    }
    assert values["sensors"] == {"gps": ["gps_x", "gps_y"], "wheel": "wheel"}
    task = read_log(columns, read_map(map_file(tmp_path, text)), "drive")[0].task
    assert task.main_error.label == "position (m)"  # 15.8 m
    small = columns | {"true_x": 0.1 * t, "true_y": 0.2 * t}
    assert read_log(small, read_map(map_file(tmp_path, text)), "drive")[0].task.main_error.label == "position (cm)"


def test_one_component_is_a_task(tmp_path: Path) -> None:
    columns = {"t": 0.1 * np.arange(20.0), "true_level": np.linspace(280.0, 290.0, 20), "est_level": np.full(20, 285.0)}
    text = guess_map(Preview(columns), "tank").replace('"true_level"', '{column = "true_level", unit = "K"}', 1)
    mapping = read_map(map_file(tmp_path, text))
    episodes = read_log(columns, mapping, "tank")
    trace = recorded_trace(columns, mapping, episodes, 0, "tank")
    assert (trace.task.map_components, trace.task.main_error.label) == (("level",), "level (K)")
    assert trace.task.map_half_width == pytest.approx(1.2 * 5.0)


@pytest.mark.parametrize("unit", ["quaternion", "quaternion_wxyz"])
def test_quaternions_become_rotations(tmp_path: Path, unit: str) -> None:
    """Of any norm, as (x, y, z, w) or (w, x, y, z); the estimate is 0.1 rad off about the body's z axis."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(30, 4))
    turn = np.array([np.cos(0.05), 0.0, 0.0, np.sin(0.05)])
    estimate = 2.0 * rotations.multiply(truth, np.broadcast_to(turn, truth.shape))
    order = [1, 2, 3, 0] if unit == "quaternion" else [0, 1, 2, 3]
    names = [f"q{i}" for i in range(4)]
    columns = {"t": 0.1 * np.arange(30.0), "z": np.arange(30.0), "est": estimate[:, order], "est_z": np.arange(30.0)}
    columns |= dict(zip(names, truth[:, order].T, strict=True))
    text = f"""
time = "t"
[state]
z = "z"
attitude = {{column = {names}, unit = "{unit}"}}
[estimate]
mean = ["est_z", "est"]
std = ["z", "z", "z", "z"]
"""
    mapping = read_map(map_file(tmp_path, text))
    episodes = read_log(columns, mapping, "log")
    trace = recorded_trace(columns, mapping, episodes, 0, "log")
    assert [c.name for c in trace.task.components] == ["z", "attitude_x", "attitude_y", "attitude_z"]
    np.testing.assert_allclose(errors(trace)[:, -1], np.broadcast_to([0.0, 0.0, 0.0, 0.1], (30, 4)), atol=1e-5)
    columns["q1"][7] = columns["q0"][7] = columns["q2"][7] = columns["q3"][7] = 0.0
    with pytest.raises(BadInput, match="state attitude has a quaternion of norm 0 in row 7"):
        read_log(columns, mapping, "log")
    with pytest.raises(BadInput, match="has a quaternion of 1 columns, expected 4"):
        read_log(columns, read_map(map_file(tmp_path, text.replace(str(names), '"z"'))), "log")


def test_times_of_the_log_are_kept(tmp_path: Path) -> None:
    """Of the episode whose steps vary; a sensor that repeats its readings has a period."""
    columns = table()
    columns["t"] = columns["t"] + 1.7e9
    columns["t"][1::2] += 0.01 * np.random.default_rng(0).uniform(0.0, 1.0, 20)
    columns["gps_x"] = np.repeat(columns["gps_x"][::8], 8)
    columns["gps_y"] = np.repeat(columns["gps_y"][::8], 8)
    mapping = read_map(map_file(tmp_path))
    regular, irregular = read_log(columns, mapping, "log")
    assert regular.time is None
    expected = columns["t"][1::2] - columns["t"][1]
    np.testing.assert_allclose(irregular.time, expected, atol=1e-6)
    assert regular.dt == irregular.dt == pytest.approx(np.median(np.diff(expected)), abs=0.005)
    assert regular.task.periods == {"gps": pytest.approx(4 * regular.dt)}
    dates = columns | {"t": (columns["t"] * 1e9).astype("datetime64[ns]")}
    np.testing.assert_allclose(read_log(dates, mapping, "log")[1].times, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"true_x"', '"truex"', "true_x"),
        ('unit = "deg"', "unit = 3", "unit of state 'yaw' is 3"),
        ('time = "t"', "", "needs either dt"),
        ('time = "t"', 'time = "gps_x"', "of episode b is -2.7.* after 0 s; expected ascending"),
        ('time = "t"', 'time = "run"', "has text"),
        ("[sensors]", "[sensor]", "sensor"),
        ('["est_x", "est_y", "est_yaw"]', '["est_x", "est_y"]', "2 columns, expected 3"),
        ('["est_x", "est_y", "est_yaw"]', "5", "is 5"),
        ('task = "vehicle"', 'task = "a/b"', "without spaces"),
        ('["sd_x", "sd_y", "sd_yaw"]', '"sd_x"', "std of .estimate. has 1 columns"),
        ("[estimate]", '[estimate]\nweights = "sd_x"', "expected a table"),
        ("[estimate]", "[estimate]\nweights = {gps = 1}", "gps in map.toml is 1"),
        ("[estimate]", '[covariates]\nv = {column = "t", cuts = [2, 1]}\n[estimate]', "covariate 'v'"),
        (
            "[estimate]",
            '[modalities]\nradio = ["gps", "imu"]\n[estimate]',
            "sensor 'imu' of modality 'radio' does not exist. Available: gps",
        ),
        ("[estimate]", '[modalities]\nradio = "gps"\n[estimate]', "modality 'radio' .* expected a list of sensors"),
        ("[sensors]", '[modalities]\ngps = ["imu"]\n[sensors]\nimu = "gps_x"', "'gps' .* rename one"),
    ],
)
def test_wrong_maps_name_the_value(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in MAP
    path = map_file(tmp_path, MAP.replace(old, new))

    def read() -> None:
        mapping = read_map(path)
        recorded_trace(table(), mapping, read_log(table(), mapping, "log"), 0, "log")

    with pytest.raises(BadInput, match=message):
        read()


def test_elements_and_lengths() -> None:
    columns = {"a": np.arange(6.0).reshape(3, 2), "b": np.arange(4.0), "name[0]": np.ones(3)}
    assert column(columns, "a[1]", "x").tolist() == [1.0, 3.0, 5.0]
    assert column(columns, "name[0]", "x").tolist() == [1.0, 1.0, 1.0]
    assert joined(columns, ["a", "name[0]"], "x").shape == (3, 3)
    for references, message in ((["a[2]"], r"no \[2\]"), (["b[0]"], r"no \[0\]"), (["a", "b"], "3, 4 rows")):
        with pytest.raises(BadInput, match=message):
            joined(columns, references, "x")


@pytest.mark.parametrize("count", [pytest.param(60, id="60"), pytest.param(10_000, marks=pytest.mark.long, id="10000")])
def test_damaged_logs_give_one_line(log: Path, tmp_path: Path, count: int) -> None:
    """Bytes are changed, removed and repeated: the columns are read, or BadInput has one line."""
    data, rng = log.read_bytes(), np.random.default_rng(2)
    damaged, messages = tmp_path / f"damaged{log.suffix}", []
    for _ in range(count):
        changed = bytearray(data)
        for place in rng.integers(0, len(data), rng.integers(1, 8)):
            changed[place] = rng.integers(256)
        if rng.random() < 0.3:
            changed = changed[: rng.integers(len(changed))]
        damaged.write_bytes(changed)
        try:
            read_columns(damaged)
        except BadInput as error:
            messages.append(str(error))
    assert not any("\n" in message for message in messages)
    assert messages or log.suffix == ".csv"


def test_damaged_maps_give_one_line(tmp_path: Path) -> None:
    """Words of a map are exchanged, repeated and removed."""
    rng, words, messages = np.random.default_rng(4), MAP.split(" "), []
    for _ in range(200):
        changed = list(words)
        for place in rng.integers(0, len(words), rng.integers(1, 4)):
            changed[place] = rng.choice([*words, "", "5", "[]", "{}", '"t"', "true"])
        try:
            mapping = read_map(map_file(tmp_path, " ".join(changed)))
            recorded_trace(table(), mapping, read_log(table(), mapping, "log"), 0, "log")
        except BadInput as error:
            messages.append(str(error))
    assert messages
    assert not any("\n" in message for message in messages)


def test_estimates_need_as_many_rows_as_the_state(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", truth=np.ones((5, 2)), estimate=np.ones((4, 2)))
    columns = read_columns(tmp_path / "log.npz")
    mapping = read_map(map_file(tmp_path, guess_map(Preview(columns), "log")))
    episodes = read_log(columns, mapping, "log")
    with pytest.raises(BadInput, match="estimate mean has 4 rows and the state 5"):
        recorded_trace(columns, mapping, episodes, 0, "log")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("est_y", np.nan, "estimate mean has no finite value in row 6, episode 0"),
        ("sd_x", np.inf, "estimate covariance has no finite value in row 6, episode 0"),
        ("sd_x", -0.5, "std of .estimate. has the value -0.5 in row 6, expected zero or more"),
        ("run", np.nan, "the episode, column 'run', has no value in row 6"),
    ],
)
def test_a_wrong_value_is_named_with_its_row(tmp_path: Path, name: str, value: float, message: str) -> None:
    columns = table() | {"run": np.tile([1.0, 0.0], 20)}
    columns[name][6] = value
    mapping = read_map(map_file(tmp_path))
    with pytest.raises(BadInput, match=message):
        recorded_trace(columns, mapping, read_log(columns, mapping, "log"), 0, "log")


def test_negative_variances_are_refused(tmp_path: Path) -> None:
    columns = {"x": np.arange(5.0), "y": np.arange(5.0), "P": np.tile(np.diag([1.0, -2.0]).ravel(), (5, 1))}
    text = 'dt = 0.1\n[state]\nx = "x"\ny = "y"\n[estimate]\nmean = ["x", "y"]\ncovariance = "P"\n'
    mapping = read_map(map_file(tmp_path, text))
    with pytest.raises(BadInput, match="has the variance -2 in row 0"):
        recorded_trace(columns, mapping, read_log(columns, mapping, "log"), 0, "log")


def test_pickled_arrays_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", a=np.array([{"x": 1}], dtype=object))
    with pytest.raises(BadInput, match="cannot be read"):
        read_columns(tmp_path / "log.npz")


def test_files_that_are_no_archives_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    for data in (b"", b"t,x", b"\x93NUMPY\x01\x00"):
        path.write_bytes(data)
        with pytest.raises(BadInput, match="is not a complete NumPy archive"):
            read_columns(path)
    with pytest.raises(BadInput, match="column 'x' of state x has complex values, expected numbers"):
        column({"x": np.ones(3, complex)}, "x", "state x")


def test_a_published_ensemble_filter(tmp_path: Path) -> None:
    """The recorded run of the differentiable ensemble Kalman filter (DEnKF) has NEES/n 0.0747 in NumPy."""
    path = Path(__file__).parents[3] / "examples" / "denkf" / "eval-13920.npz"
    columns = read_columns(path)
    text = guess_map(Preview(columns), "vehicle")
    mapping = read_map(map_file(tmp_path, text))
    trace = recorded_trace(columns, mapping, read_log(columns, mapping, path.name), 0, path.name)
    assert nees(trace)[:, -1].mean() == pytest.approx(0.0747, rel=0.01)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (["0.1", "0.2", "", "oops", "0.4"], "has text, such as 'oops' in row 3, expected numbers"),
        ([None] * 5, "has no value, expected numbers"),
        (["None"] * 5, "has no value, expected numbers"),
    ],
    ids=["text", "empty", "empty-as-text"],
)
def test_the_error_of_a_column_names_the_first_value_that_is_no_number(values: list[str | None], message: str) -> None:
    with pytest.raises(BadInput, match=re.escape(f"column 'g' of sensor gps {message}")):
        column({"g": np.array(values, dtype=object)}, "g", "sensor gps")

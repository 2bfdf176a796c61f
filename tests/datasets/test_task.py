"""Consistency of the registered tasks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.catalog import TASKS, find_task, load_task
from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.task import Component, Task, axis_name
from beliefscope.datasets.task_json import check_definition, difference, task_from_json, task_to_json


def test_channels_are_axes_up_to_three_and_numbers_from_0() -> None:
    assert [axis_name("gps", i, 2) for i in range(2)] == ["gps x", "gps y"]
    assert [axis_name("joints", i, 7) for i in (0, 6)] == ["joints 0", "joints 6"]
    assert axis_name("speed", 0, 1) == "speed"
    assert DOOR.channel("force", 2) == Component("force z", "N")


RADAR = replace(
    DOOR,
    observations={**DOOR.observations, "radar": (2,), "speed": (1,)},
    modalities={**DOOR.modalities, "radar": ("radar", "speed")},
    channels={"radar": (Component("range", "m"), Component("bearing", "rad")), "speed": (Component("v", "m/s"),)},
)


def test_channels_have_names_and_units() -> None:
    assert RADAR.channel("radar", 1) == Component("radar bearing", "rad")
    assert RADAR.channel("speed", 0) == Component("speed", "m/s")
    assert [channel.name for channel in RADAR.vector_channels()][-3:] == ["radar range", "radar bearing", "speed"]
    check_definition(RADAR)
    definition = json.loads(json.dumps(task_to_json(RADAR)))
    assert task_from_json(definition).channels == RADAR.channels
    del definition["channels"]  # as in files of earlier versions
    assert task_from_json(definition).channels == {}
    outdoors = replace(RADAR, map_half_width=50.0)
    assert outdoors.channel("radar", 0).conversion == ("m", 1.0)


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"radar": ("range", "bearing")}, r"component 'range', expected Component\("),
        ({"radar": (Component("range", "m"),)}, "channels of 'radar' are 1, expected 2 names"),
        ({"image": (Component("gray", ""),)}, r"channels of 'image' are 1, expected an observation \(d,\) or control"),
        ({"lidar": (Component("range", "m"),)}, r"expected an observation \(d,\) or control"),
        ({"radar": 2 * (Component("range", "m"),)}, "channels of 'radar' have equal names"),
        ({"speed": (Component("m/s", "m/s"),)}, "channel 'm/s' of 'speed' has an invalid name, expected a text"),
    ],
)
def test_invalid_channels_are_refused(channels: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        check_definition(replace(RADAR, channels=channels))


@pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))
def test_task_is_consistent(task) -> None:  # type: ignore[no-untyped-def]
    keys = [key for keys in task.modalities.values() for key in keys]
    assert sorted(keys) == sorted(task.observations), "each observation belongs to one modality"
    x, y = task.map_indices
    assert x != y
    assert {task.components[i].unit for i in (x, y)} == {"m"}
    assert find_task(task.name) is task


def test_unknown_names_list_the_available_ones() -> None:
    with pytest.raises(BadInput, match=r"task 'dor' does not exist\. Available: door"):
        find_task("dor")
    with pytest.raises(BadInput, match=r"component 'hinge_z' of task 'door' .*Available: hinge_x, hinge_y, angle"):
        find_task("door").index("hinge_z")


def test_parts_of_the_wrong_type_are_refused() -> None:
    with pytest.raises(BadInput, match=r"component 'hinge_x', expected Component\("):
        replace(DOOR, components=("hinge_x",))  # type: ignore[arg-type]
    with pytest.raises(BadInput, match=r"covariate 'fix' is 'boolean', expected Covariate\("):
        check_definition(replace(DOOR, covariates={"fix": "boolean"}))  # type: ignore[dict-item]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observations": {"imu/rate": (3,)}, "modalities": {"imu": ("imu/rate",)}}, "observation 'imu/rate' has an"),
        ({"modalities": {"a+b": ("speed",)}}, r"modality 'a\+b' has an invalid name, expected a text without / and \+"),
        ({"components": (Component("pose/x", "m"), Component("y", "m"))}, "component 'pose/x' has an invalid name"),
        ({"covariates": {"a/b": Covariate("boolean")}}, "covariate 'a/b' has an invalid name"),
    ],
)
def test_new_names_have_no_separators_and_stored_ones_open(change: dict[str, Any], message: str) -> None:
    fields: dict[str, Any] = {"components": (Component("x", "m"), Component("y", "m")), "observations": {"speed": (2,)}}
    task = Task(**fields | {"name": "own", "modalities": {"speed": ("speed",)}, "control_size": 0, "dt": 0.1} | change)
    with pytest.raises(BadInput, match=message):
        check_definition(task)
    if "covariates" not in change:
        assert task_from_json(task_to_json(task)) == task


def test_the_file_of_a_task_imports_files_next_to_it(tmp_path: Path) -> None:
    (tmp_path / "lengths_of_it.py").write_text("UNIT = 'mm'\n")
    (tmp_path / "own.py").write_text(
        "import beliefscope as bs\nfrom lengths_of_it import UNIT\n"
        "TASK = bs.Task('rod', (bs.Component('x', UNIT),), {'gauge': (1,)}, {'gauge': ('gauge',)}, 0, 0.1)\n"
    )
    assert load_task(f"{tmp_path / 'own.py'}:TASK").components[0].unit == "mm"


@pytest.mark.parametrize(
    ("units", "expected", "key"),
    [
        (("m", "m"), ("position", "cm", 100.0, (0, 1)), "position_cm"),
        (("mm", "mm"), ("position", "mm", 1.0, (0, 1)), "position_mm"),
        (("K", "K"), ("hinge x and hinge y", "K", 1.0, (0, 1)), "hinge_x_and_hinge_y_K"),
        (("m", "K"), ("hinge x", "cm", 100.0, (0,)), "hinge_x_cm"),
        (("", ""), ("hinge x and hinge y", "", 1.0, (0, 1)), "hinge_x_and_hinge_y"),
    ],
)
def test_main_error_is_that_of_map_components_of_one_unit(
    units: tuple[str, str], expected: tuple[object, ...], key: str
) -> None:
    parts = [replace(c, unit=unit) for c, unit in zip(DOOR.components, units, strict=False)]
    main = replace(DOOR, components=(*parts, *DOOR.components[2:])).main_error
    assert (main.name, main.unit, main.factor, main.indices) == expected
    assert main.key == key
    assert main.norm(np.array([[3.0, 4.0, 7.0]]))[0] == (5.0 if len(main.indices) == 2 else 3.0)
    assert replace(DOOR, components=(*parts, *DOOR.components[2:])).floor == ((0, 1) if units == ("m", "m") else None)


@pytest.mark.parametrize(("half_width", "key"), [(4.9, "east_cm"), (5.0, "east_m")])
def test_lengths_of_a_large_map_are_in_metres(half_width: float, key: str) -> None:
    components = (Component("east", "m"), Component("north", "m"), Component("height", "m", display=("mm", 1e3)))
    task = Task("field", components, {"gps": (2,)}, {"gps": ("gps",)}, 0, 0.1, map_half_width=half_width)
    assert [component.key for component in task.components][::2] == [key, "height_mm"]
    assert task.main_error.key == f"position_{key.partition('_')[2]}"
    assert not difference(task_from_json(task_to_json(task)), task)


def test_angles_are_displayed_in_the_turn_of_the_reference() -> None:
    task = Task("cart", (Component("x", "m"), Component("yaw", "rad")), {"gps": (1,)}, {"gps": ("gps",)}, 0, 0.1)
    states = np.array([[50.0, -3.1], [50.0, 0.2], [50.0, 0.1]], np.float32)
    reference = np.array([[0.0, 3.1], [0.0, 6.4], [0.0, np.nan]], np.float32)
    near = task.near(states, reference)
    np.testing.assert_allclose(near, [[50.0, 2 * np.pi - 3.1], [50.0, 0.2 + 2 * np.pi], [50.0, 0.1]], rtol=1e-6)
    assert np.array_equal(task.near(states, states), states)

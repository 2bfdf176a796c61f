"""Statistics of datasets and the published reference values."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.dataset_statistics import PAPER_DATA, comparison_table, default_size, statistics
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path


def episode(states: list[list[float]], position: list[list[float]], contact: list[bool]) -> Episode:
    steps = len(states)
    observations = {
        "effector_position": np.array(position, np.float32),
        "force": np.outer(np.arange(steps) % 2, (2.0, 4.0, 0.0)).astype(np.float32),
    }
    return Episode(
        DOOR,
        np.array(states, np.float32),
        np.zeros((steps, 7), np.float32),
        observations,
        np.array(contact),
        np.zeros((steps, 0), np.float32),
        0.1,
        0,
    )


def test_statistics_of_two_episodes() -> None:
    """Standard deviations pool the episodes; displacements stay within each."""
    first = episode([[0.0, 1.0, 0.0], [0.0, 1.0, np.pi]], [[0.0, 0, 0], [0.01, 0, 0]], [True, False])
    second = episode([[0.2, 1.0, 0.0], [0.2, 1.0, np.pi]], [[0.5, 0, 0], [0.53, 0, 0]], [False, False])
    result = statistics(DOOR, [first, second])
    assert result["contact_fraction"] == 0.25
    assert [
        result[f"{name}_std_{unit}"] for name, unit in (("hinge_x", "cm"), ("hinge_y", "cm"), ("angle", "deg"))
    ] == (pytest.approx([10.0, 0.0, 90.0], rel=1e-6))
    assert result["effector_range_cm"] == pytest.approx([53.0, 0.0, 0.0])
    assert result["effector_step_std_mm"] == pytest.approx([10.0, 0.0, 0.0], rel=1e-5)
    assert result["force_std_N"] == pytest.approx([1.0, 2.0, 0.0])
    assert "torque_std_Nm" not in result, "no torque observation"


def test_statistics_without_haptics() -> None:
    plain = dataclasses.replace(episode([[0.0] * 3] * 2, [[0.0] * 3] * 2, [True, True]), observations={})
    assert list(statistics(DOOR, [plain])) == ["contact_fraction", "hinge_x_std_cm", "hinge_y_std_cm", "angle_std_deg"]


def test_comparison_table_has_one_number_in_each_cell() -> None:
    ours = {"contact_fraction": 0.5, "range_std_m/s": 3.0, "effector_step_std_mm": [2.0, 1.0, 3.0]}
    columns, rows = comparison_table(ours, {"contact_fraction": 0.25, "effector_step_std_mm": [4.0, 1.0, 1.0]})
    assert columns == ["quantity", "measure", "unit", "this data set", "paper", "this / paper"]
    assert rows == [
        ["steps in contact", "share", "", 0.5, 0.25, 2.0],
        ["range", "standard deviation", "m/s", 3.0, None, None],
        ["effector displacement per step x", "standard deviation", "mm", 2.0, 4.0, 0.5],
        ["effector displacement per step y", "standard deviation", "mm", 1.0, 1.0, 1.0],
        ["effector displacement per step z", "standard deviation", "mm", 3.0, 1.0, 3.0],
    ]


def test_comparison_table_without_published_data_has_no_columns_for_them() -> None:
    columns, rows = comparison_table({"contact_fraction": 0.5}, {})
    assert columns == ["quantity", "measure", "unit", "this data set"]
    assert rows == [["steps in contact", "share", "", 0.5]]


@pytest.mark.parametrize("name", PAPER_DATA)
def test_published_statistics_have_the_same_shapes(name: str) -> None:
    with open_dataset(sample_path(name)) as data:
        ours = statistics(TASKS[name], (data[i] for i in range(10)))
    theirs = PAPER_DATA[name].statistics
    assert theirs.keys() <= ours.keys()
    assert {key: np.shape(value) for key, value in theirs.items()} == {key: np.shape(ours[key]) for key in theirs}


def test_default_size_matches_the_paper() -> None:
    assert (default_size("door"), default_size("push")) == ((600, 800), (1000, 250))
    assert default_size("user task") == (100, 200)

"""The statistics of a set, by hand, and what they are compared with."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.statistics import AUTHORS, scale, statistics
from beliefscope.datasets.store import open_dataset, sample_path


def episode(states: list[list[float]], position: list[list[float]], contact: list[bool]) -> Episode:
    steps = len(states)
    observations = {
        "effector_position": np.array(position, np.float32),
        "force": np.outer(np.arange(steps) % 2, (2.0, 4.0, 0.0)).astype(np.float32),
    }
    return Episode(
        "door",
        np.array(states, np.float32),
        np.zeros((steps, 7), np.float32),
        observations,
        np.array(contact),
        np.zeros((steps, 0), np.float32),
        0.1,
        0,
    )


def test_by_hand() -> None:
    """Two episodes: spreads are over both, ways only within each."""
    first = episode([[0.0, 1.0, 0.0], [0.0, 1.0, np.pi]], [[0.0, 0, 0], [0.01, 0, 0]], [True, False])
    second = episode([[0.2, 1.0, 0.0], [0.2, 1.0, np.pi]], [[0.5, 0, 0], [0.53, 0, 0]], [False, False])
    found = statistics(DOOR, [first, second])
    assert found["contact_fraction"] == 0.25
    assert [found[f"{name}_std_{unit}"] for name, unit in (("hinge_x", "cm"), ("hinge_y", "cm"), ("angle", "deg"))] == (
        pytest.approx([10.0, 0.0, 90.0], rel=1e-6)
    )
    assert found["effector_range_cm"] == pytest.approx([53.0, 0.0, 0.0])
    assert found["effector_step_std_mm"] == pytest.approx([10.0, 0.0, 0.0], rel=1e-5)
    assert found["force_std_N"] == pytest.approx([1.0, 2.0, 0.0])
    assert "torque_std_Nm" not in found, "there is none"


def test_without_haptics_only_state_and_contact_are_left() -> None:
    bare = dataclasses.replace(episode([[0.0] * 3] * 2, [[0.0] * 3] * 2, [True, True]), observations={})
    assert list(statistics(DOOR, [bare])) == ["contact_fraction", "hinge_x_std_cm", "hinge_y_std_cm", "angle_std_deg"]


@pytest.mark.parametrize("name", AUTHORS)
def test_what_the_authors_published_is_compared_axis_by_axis(name: str) -> None:
    with open_dataset(sample_path(name)) as data:
        ours = statistics(TASKS[name], (data[i] for i in range(10)))
    theirs = AUTHORS[name].statistics
    assert theirs.keys() <= ours.keys()
    assert {key: np.shape(value) for key, value in theirs.items()} == {key: np.shape(ours[key]) for key in theirs}


def test_scale_is_the_papers() -> None:
    assert (scale("door"), scale("push")) == ((600, 800), (1000, 250))
    assert scale("a task of one's own") == (100, 200)

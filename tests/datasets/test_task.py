"""Consistency of the registered tasks."""

from __future__ import annotations

import pytest

from beliefscope.datasets.catalog import TASKS, find_task
from beliefscope.datasets.errors import BadInput


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
    with pytest.raises(BadInput, match=r"component of task 'door' 'hinge_z' .*Available: hinge_x, hinge_y, angle"):
        find_task("door").index("hinge_z")

"""Definitions of tasks as data: exact, complete, validated; functions only from tasks of the same layout."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.catalog import TASKS, find_task, stored_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.task import Component, Task
from beliefscope.datasets.task_json import FUNCTIONS, difference, task_from_json, task_to_json, with_functions


def stored(task: Task) -> Any:
    return read_json(json.dumps(task_to_json(task)))


@pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))
def test_round_trip(task: Task) -> None:
    copy = task_from_json(stored(task))
    assert task_to_json(copy) == task_to_json(task)
    assert difference(task, copy) == ""
    assert all(getattr(copy, name) is None for name in FUNCTIONS)
    assert with_functions(copy, task) is task
    assert stored_task(stored(task)) is task
    assert stored_task(task.name) is task


def test_functions_come_only_from_tasks_of_the_same_layout() -> None:
    wider = replace(DOOR, map_half_width=1.0)
    assert stored_task(stored(wider)).map_half_width == 1.0
    assert stored_task(stored(wider)).simulate is DOOR.simulate
    other = replace(DOOR, components=(*DOOR.components, Component("speed", "m")))
    assert stored_task(stored(other)).simulate is None
    assert stored_task(stored(other), given=[other]) is other
    assert stored_task(stored(other), given=[DOOR]).simulate is None
    mine = replace(other, name="mine")
    assert stored_task("mine", given=[mine]) is mine
    with pytest.raises(BadInput, match="task 'mine' does not exist"):
        stored_task("mine")


def test_differences_are_named() -> None:
    assert difference(DOOR, replace(DOOR, map_half_width=1.0)) == ""
    assert difference(DOOR, find_task("push")) == "task 'push'"
    x, y, angle = DOOR.components
    assert difference(DOOR, replace(DOOR, components=(replace(x, display=("mm", 1e3)), y, angle))) == ""
    message = difference(DOOR, replace(DOOR, components=(x, y, replace(angle, wraps=True))))
    assert "hinge_x" not in message
    assert "'name': 'angle'" in message
    other = replace(DOOR, control_size=3)
    assert difference(DOOR, other) == "a task with the same name 'door' but other control_size: 3"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "a:b"}, "is named 'a:b', expected a name without spaces"),
        ({"name": 3}, "is named 3, expected a name"),
        ({"components": []}, r"has the components \[\], expected one or more"),
        ({"components": [{"name": "x", "unit": "mile", "static": False}] * 2}, "expected one or more with different"),
        ({"components": [{"name": "x", "unit": 3, "static": False}]}, "component 'x' has unit 3, expected a text"),
        ({"observations": {"image": [0, 4]}}, r"observation 'image' has shape \(0, 4\)"),
        ({"observations": {"image": [1e30]}}, "observation 'image' has shape"),
        ({"modalities": {"image": ["touch"]}}, "'touch', which is not an observation"),
        ({"map_components": ["x", "hinge_y"]}, "component 'x' of task 'door' does not exist"),
        ({"dt": 0}, "dt is 0 s and map_half_width"),
        ({"warmup": -1}, "warmup is -1, expected a whole number"),
        ({"control_size": True}, "control_size is True"),
        ({"positions": {"control": [1]}}, "positions of 'control'"),
        ({"start_distance": {"m": [1, "x"]}}, "start distance of 'm'"),
        ({"camera": {}}, "incomplete definition of a task: KeyError: 'position'"),
        ({"observations": 3}, "incomplete definition of a task: AttributeError"),
    ],
)
def test_invalid_definitions_are_rejected(change: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        task_from_json(stored(DOOR) | change)


@pytest.mark.slow
def test_mutated_definitions_give_a_task_or_one_line() -> None:
    """500 definitions with a value replaced, at any depth."""
    rng = np.random.default_rng(0)
    values = [None, "", "x", -1, 0, 1.5, 1e308, True, [], {}, [[]], {"a": 1}, "m" * 300, [1, 2, 3]]

    def places(node: Any) -> list[tuple[Any, Any]]:
        keys = node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        return [pair for key in keys for pair in [(node, key), *places(node[key])]]

    rejected = []
    for _ in range(500):
        document = stored(find_task("door-field"))
        nodes = places(document)
        node, key = nodes[rng.integers(len(nodes))]
        node[key] = values[rng.integers(len(values))]
        try:
            task = task_from_json(document)
        except BadInput as error:
            rejected.append(str(error))
        else:
            assert task_to_json(task_from_json(task_to_json(task))) == task_to_json(task)
    assert rejected
    assert all(len(message.splitlines()) == 1 for message in rejected)

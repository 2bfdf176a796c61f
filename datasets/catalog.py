"""Registry of tasks. To add a task, write one file and add it to ``TASKS``."""

from __future__ import annotations

import copyreg
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.io import user_code
from beliefscope.datasets.readers.push_real_task import PUSH_REAL_TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.door_field import DOOR_FIELD
from beliefscope.datasets.simulation.push import PUSH
from beliefscope.datasets.simulation.push_field import PUSH_FIELD
from beliefscope.datasets.simulation.push_field_yaw import PUSH_FIELD_YAW
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import check_definition, difference, task_from_json, task_to_json, with_functions

TASKS: dict[str, Task] = {
    task.name: task for task in (DOOR, PUSH, DOOR_FIELD, PUSH_FIELD, PUSH_FIELD_YAW, *PUSH_REAL_TASKS)
}
"""Built-in tasks by name."""


def find_task(task: str | Task) -> Task:
    """Return the built-in task with the name, or the given one. Runs no user code, so names read from files are safe.

    Raises:
        BadInput: for an unknown name.
    """
    if isinstance(task, Task):
        return task
    if task in TASKS:
        return TASKS[task]
    unknown = unknown_name("task", task, TASKS)
    raise BadInput(f"{unknown} Give a task of your own as FILE.py:NAME.")


def stored_task(stored: Any, given: Iterable[Task] = ()) -> Task:
    """Task of a file: its definition, or the name that earlier versions stored. Runs no code.

    Args:
        stored: JSON value of the file. given: tasks that the user has loaded. The functions of a task are those of a
            given or built-in one with the same name and layout; without one, the task has none.

    Raises:
        BadInput: for an invalid definition, and for the name of a task that is neither given nor built in.
    """
    tasks = [*given, *TASKS.values()]
    if isinstance(stored, str):
        return next((task for task in tasks if task.name == stored), None) or find_task(stored)
    task = task_from_json(stored)
    source = next((other for other in tasks if not difference(task, other)), None)
    return task if source is None else with_functions(task, source)


def _reduce(task: Task) -> tuple[Any, ...]:
    """For other processes: by definition, as some of its functions cannot be pickled."""
    return stored_task, (task_to_json(task),)


copyreg.pickle(Task, _reduce)


def load_task(task: str | Task) -> Task:
    """Return a built-in task by name, or a user-defined one. Runs user code: not for names read from files.

    Args:
        task: name, definition, or ``FILE.py:NAME`` or ``MODULE:NAME``, which runs the file once.

    Raises:
        BadInput: for an unknown name, a file that cannot be run, or a missing or inconsistent task.
    """
    if isinstance(task, Task):
        check_definition(task)
        return task
    return _load_user_task(task) if ":" in task and task not in TASKS else find_task(task)


_user_tasks: dict[tuple[str, str], Task] = {}
"""(file or module, attribute) -> task loaded from there."""


def _load_user_task(name: str) -> Task:
    place, _, attribute = name.rpartition(":")
    key = (str(Path(place).resolve()) if place.endswith(".py") else place, attribute)
    if key not in _user_tasks:
        with user_code.importable(place):
            module = user_code.load_module(place)
        task = getattr(module, attribute, None)
        if not isinstance(task, Task):
            available = ", ".join(n for n, value in vars(module).items() if isinstance(value, Task)) or "none"
            raise BadInput(f"{place} has no task {attribute!r}. Available: {available}.")
        check_definition(task, name)
        _user_tasks[key] = task
    return _user_tasks[key]

"""Registry of tasks. To add a task, write one file and add it to ``TASKS``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.io import user_code
from beliefscope.datasets.readers.push_real_task import PUSH_REAL_TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.door_field import DOOR_FIELD
from beliefscope.datasets.simulation.push import PUSH
from beliefscope.datasets.simulation.push_field import PUSH_FIELD
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import check_definition, difference, task_from_json, with_functions

TASKS: dict[str, Task] = {task.name: task for task in (DOOR, PUSH, DOOR_FIELD, PUSH_FIELD, *PUSH_REAL_TASKS)}
"""Shipped tasks by name."""


def find_task(name: str) -> Task:
    """Return a shipped task. Runs no user code, so names read from files are safe.

    Raises:
        BadInput: for an unknown name.
    """
    if name in TASKS:
        return TASKS[name]
    unknown = unknown_name("task", name, TASKS)
    raise BadInput(f"{unknown} Give a task of your own as path/to/file.py:NAME.")


def stored_task(stored: Any, given: Task | None = None) -> Task:
    """Task of a file: its definition, or the name that earlier versions stored. Runs no code.

    Args:
        stored: JSON value of the file. given: task that the user has loaded for the file. Functions of the task are
            those of the given task, else of the shipped one, if it has the same name and layout.

    Raises:
        BadInput: for an invalid definition, and for a name that is not given nor shipped.
    """
    if isinstance(stored, str):
        return given if given is not None and given.name == stored else find_task(stored)
    task = task_from_json(stored)
    source = TASKS.get(task.name) if given is None or difference(given, task) else given
    return task if source is None or difference(source, task) else with_functions(task, source)


def load_task(name: str) -> Task:
    """Return a registered task or load a user-defined one. Runs user code: not for names read from files.

    ``path/to/file.py:NAME`` or ``package.module:NAME`` runs the file and registers its task in ``TASKS``.

    Raises:
        BadInput: for an unknown name, a file that cannot be run, or a missing or inconsistent task.
    """
    return _load_user_task(name) if ":" in name and name not in TASKS else find_task(name)


_user_tasks: dict[tuple[str, str], Task] = {}
"""(file or module, attribute) -> task loaded from there."""


def _load_user_task(name: str) -> Task:
    place, _, attribute = name.rpartition(":")
    key = (str(Path(place).resolve()) if place.endswith(".py") else place, attribute)
    if key not in _user_tasks:
        module = user_code.load_module(place)
        task = getattr(module, attribute, None)
        if not isinstance(task, Task):
            available = ", ".join(n for n, value in vars(module).items() if isinstance(value, Task)) or "none"
            raise BadInput(f"{place} has no task {attribute!r}. Available: {available}.")
        check_definition(task, name)
        if task.name in TASKS:
            raise BadInput(f"{name} is named {task.name!r}, which is already used. Existing tasks: {', '.join(TASKS)}.")
        _user_tasks[key] = TASKS[task.name] = task
    return _user_tasks[key]

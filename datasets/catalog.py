"""Registry of tasks. To add a task, write one file and add it to ``TASKS``."""

from __future__ import annotations

from pathlib import Path

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.io import user_code
from beliefscope.datasets.readers.push_real_task import PUSH_REAL_TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.door_field import DOOR_FIELD
from beliefscope.datasets.simulation.push import PUSH
from beliefscope.datasets.simulation.push_field import PUSH_FIELD
from beliefscope.datasets.task import Task

TASKS: dict[str, Task] = {task.name: task for task in (DOOR, PUSH, DOOR_FIELD, PUSH_FIELD, *PUSH_REAL_TASKS)}


def find_task(name: str) -> Task:
    """Return a registered task. Runs no user code, so names read from files are safe.

    Raises:
        BadInput: for an unknown name.
    """
    if name in TASKS:
        return TASKS[name]
    unknown = unknown_name("task", name, TASKS)
    raise BadInput(f"{unknown} Give a task of your own as path/to/file.py:NAME.")


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
        _check(task, name)
        _user_tasks[key] = TASKS[task.name] = task
    return _user_tasks[key]


def _check(task: Task, name: str) -> None:
    """Raise BadInput for a duplicate name or inconsistent fields."""
    if task.name in TASKS:
        raise BadInput(f"{name} is named {task.name!r}, which is already used. Existing tasks: {', '.join(TASKS)}.")
    if not task.name or set(task.name) & set("/\\: "):
        raise BadInput(f"{name} is named {task.name!r}, expected a name without spaces, colons and slashes.")
    for component in task.map_components:
        task.index(component)
    for modality, keys in task.modalities.items():
        missing = [key for key in keys if key not in task.observations]
        if missing:
            raise BadInput(f"{name}: modality {modality!r} has {missing[0]!r}, which is not an observation.")
        ranks = [len(task.observations[key]) for key in keys]
        if ranks != [2] and set(ranks) != {1}:
            raise BadInput(f"{name}: modality {modality!r} has {', '.join(keys)}, expected one image or only vectors.")
    if task.dt <= 0 or task.map_half_width <= 0:
        raise BadInput(f"{name}: dt is {task.dt} s and map_half_width {task.map_half_width} m, expected more than 0.")

"""Every task there is. A new task is one file and one line here."""

from __future__ import annotations

from pathlib import Path

from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.io import user_code
from beliefscope.datasets.readers.push_real_task import PUSH_REAL_TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.push import PUSH
from beliefscope.datasets.task import Task

TASKS: dict[str, Task] = {task.name: task for task in (DOOR, PUSH, *PUSH_REAL_TASKS)}


def find_task(name: str) -> Task:
    """The task of that name. Names may come out of files: nothing is run. Raises BadInput for an unknown one."""
    if name in TASKS:
        return TASKS[name]
    unknown = one_of("task", name, TASKS)
    raise BadInput(f"{unknown} One of your own is named by its file: path/to/file.py:NAME.")


def load_task(name: str) -> Task:
    """The task that a user names, who may run code of their own; never for names out of files.

    ``path/to/file.py:NAME`` and ``package.module:NAME`` stand for a task of the user's own: the file is run, and its
    task is from then on in ``TASKS`` under its own name.

    Raises:
        BadInput: for an unknown name, and where a file cannot be run, holds no such task, or one that is not coherent.
    """
    return _foreign(name) if ":" in name and name not in TASKS else find_task(name)


_FOREIGN: dict[tuple[str, str], Task] = {}
"""(file or module, attribute) -> the task that was found there."""


def _foreign(name: str) -> Task:
    place, _, attribute = name.rpartition(":")
    key = (str(Path(place).resolve()) if place.endswith(".py") else place, attribute)
    if key not in _FOREIGN:
        module = user_code.run(place)
        task = getattr(module, attribute, None)
        if not isinstance(task, Task):
            found = ", ".join(n for n, value in vars(module).items() if isinstance(value, Task)) or "none"
            raise BadInput(f"{place} holds no task {attribute!r}. Tasks in it: {found}.")
        _check(task, name)
        _FOREIGN[key] = TASKS[task.name] = task
    return _FOREIGN[key]


def _check(task: Task, name: str) -> None:
    """Raises BadInput where a task's fields do not fit each other."""
    if task.name in TASKS:
        raise BadInput(f"{name} is named {task.name!r}, which is taken. Tasks there are: {', '.join(TASKS)}.")
    if not task.name or set(task.name) & set("/\\: "):
        raise BadInput(f"{name} is named {task.name!r}, expected a name without spaces, colons and slashes.")
    for component in task.map_components:
        task.index(component)
    for modality, keys in task.modalities.items():
        missing = [key for key in keys if key not in task.observations]
        if missing:
            raise BadInput(f"{name}: modality {modality!r} has {missing[0]!r}, which is not among its observations.")
        ranks = [len(task.observations[key]) for key in keys]
        if ranks != [2] and set(ranks) != {1}:
            raise BadInput(
                f"{name}: modality {modality!r} has {', '.join(keys)}, expected one picture or only vectors."
            )
    if task.dt <= 0 or task.map_half_width <= 0:
        raise BadInput(f"{name}: dt is {task.dt} s and map_half_width {task.map_half_width} m, expected more than 0.")

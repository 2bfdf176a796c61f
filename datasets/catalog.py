"""Every task there is. A new task is one file and one line here."""

from __future__ import annotations

from beliefscope.datasets.door import DOOR
from beliefscope.datasets.errors import one_of
from beliefscope.datasets.push import PUSH
from beliefscope.datasets.push_real import PUSH_REAL_TASKS
from beliefscope.datasets.task import Task

TASKS: dict[str, Task] = {task.name: task for task in (DOOR, PUSH, *PUSH_REAL_TASKS)}


def find_task(name: str) -> Task:
    """The task of that name. Raises BadInput for an unknown one."""
    if name not in TASKS:
        raise one_of("task", name, TASKS)
    return TASKS[name]

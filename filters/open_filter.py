"""Filters by the name, path or build function that a user gives."""

from __future__ import annotations

import copyreg
from pathlib import Path
from typing import Any

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint
from beliefscope.filters.external.load import ExternalFilter, load_external
from beliefscope.filters.names import is_code, is_path, pretrained_path


def open_filter(task: str | Task, text: str) -> Checkpoint:
    """Load a pretrained filter by name, a checkpoint by path, or an external filter by its build function.

    Args:
        task: definition, name or ``FILE.py:NAME``. A checkpoint file needs only the name.

    Raises BadInput if there is none, or if it is for another task.
    """
    if not is_path(text):
        task = load_task(task)
        return load_external(text, task) if is_code(text) else load_checkpoint(pretrained_path(task, text))
    given = () if isinstance(task, str) and ":" not in task else (load_task(task),)
    checkpoint = load_checkpoint(Path(text), given)
    name = given[0].name if given else task
    other = difference(given[0], checkpoint.task) if given else ""
    if other or checkpoint.task.name != name:
        raise BadInput(f"filter {text!r} is for {other or f'task {checkpoint.task.name!r}'}, not for {name!r}")
    return checkpoint


def open_filters(task: str | Task | None, first: str, second: str) -> tuple[Checkpoint, Checkpoint]:
    """Two filters of one task. task: required for two names. Raises BadInput as ``open_filter``."""
    given = [load_task(task)] if isinstance(task, Task) or (task is not None and ":" in task) else []
    loaded: dict[str, Checkpoint] = {}
    for text in (first, second):
        if is_code(text):
            loaded[text] = load_external(text, task or "")
        elif is_path(text):
            loaded[text] = load_checkpoint(Path(text), given)
    if task is None and not loaded:
        raise BadInput(f"{first!r} and {second!r} are filter names and need a task, such as --task door")
    target = task or next(iter(loaded.values())).task
    before, after = (loaded.get(text) or open_filter(target, text) for text in (first, second))
    return before, after


def _reduce(external: ExternalFilter) -> tuple[Any, ...]:
    """For other processes, which call the build function. Raises BadInput if there is none."""
    if not is_code(external.source):
        raise BadInput(
            f"{external.source} was built in Python and cannot run in other processes: use one worker, or load it by "
            "its build function, FILE.py:FUNCTION"
        )
    return load_external, (external.source, external.task)


copyreg.pickle(ExternalFilter, _reduce)

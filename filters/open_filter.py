"""Filters by the name, path or build function that a user gives."""

from __future__ import annotations

import os
from pathlib import Path

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.filters.external.load import load_external


def is_path(text: str) -> bool:
    """Whether the text is the path of a checkpoint rather than a filter name."""
    return text.endswith(".safetensors") or os.sep in text


def is_code(text: str) -> bool:
    """Whether the text names a build function: ``package.module:build`` or ``path/to/file.py:build``."""
    return ":" in text and not text.endswith(".safetensors")


def open_filter(task: str, text: str) -> Checkpoint:
    """Load a built-in filter by name, a checkpoint by path, or an external filter by its build function.

    Raises BadInput if there is none, or if it is for another task.
    """
    name = load_task(task).name
    if is_code(text):
        return load_external(text, name)
    checkpoint = load_checkpoint(Path(text) if is_path(text) else shipped(name, text))
    if checkpoint.task.name != name:
        raise BadInput(f"filter {text!r} is for task {checkpoint.task.name!r}, not for {name!r}")
    return checkpoint


def open_filters(task: str | None, first: str, second: str) -> tuple[Checkpoint, Checkpoint]:
    """Two filters of one task. task: required for two names. Raises BadInput as ``open_filter``."""
    files = {text: load_checkpoint(Path(text)) for text in (first, second) if is_path(text)}
    if task is None and not files:
        raise BadInput(f"{first!r} and {second!r} are filter names and need a task, such as --task door")
    name = task or next(iter(files.values())).task.name
    before, after = (files.get(text) or open_filter(name, text) for text in (first, second))
    return before, after

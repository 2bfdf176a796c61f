"""Names of the built-in filters and their shipped checkpoints. Without PyTorch: a wrong name is reported at once."""

from __future__ import annotations

import ast
import os
from contextlib import suppress
from pathlib import Path
from typing import Literal

from beliefscope.datasets.catalog import TASKS, find_task
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference

PRETRAINED = Path(__file__).parent / "pretrained"

MODELS: dict[str, Literal["each", "all", "one"]] = {
    "crossmodal-ekf": "each",
    "crossmodal-pf": "each",
    "crossmodal-ukf": "each",
    "information-ekf": "each",
    "information-pf": "each",
    "unimodal-ekf": "each",
    "unimodal-pf": "each",
    "feature-ekf": "all",
    "feature-pf": "all",
    "{modality}-ekf": "one",
    "{modality}-pf": "one",
    "lstm": "all",
    "transformer": "all",
}
"""Filter -> measurement models. ``each``: one model per modality. ``all``: one model of all modalities. ``one``: a
filter per modality, with that modality only (``image-pf``, ``haptics-pf``)."""


def filter_names(task: Task) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Name of each filter of a task -> its key in ``MODELS``, and measurement models named after the modalities."""
    each = tuple(task.modalities)
    models: dict[str, list[tuple[str, ...]]] = {
        "each": [each],
        "all": [("+".join(each),)],
        "one": [(modality,) for modality in each],
    }
    return {key.format(modality=names[0]): (key, names) for key, kind in MODELS.items() for names in models[kind]}


def shipped(task: str | Task, name: str) -> Path:
    """Path of the pretrained checkpoint of a task and filter. Raises BadInput if there is none."""
    check_not_source(name)
    definition = find_task(task)
    filters, task = filter_names(definition), definition.name
    paths = {filter_: PRETRAINED / f"{task}-{filter_}.safetensors" for filter_ in filters}
    is_shipped = task in TASKS and not difference(TASKS[task], definition)
    available = [filter_ for filter_, path in paths.items() if is_shipped and path.is_file()]
    if name not in filters:
        raise unknown_name("filter", name, available)
    if name not in available:
        raise BadInput(
            f"no pretrained {name!r} for task {task!r}; train one: beliefscope train {task} --filter {name}. "
            f"Available: {', '.join(available) or 'none'}."
        )
    return paths[name]


def check_not_source(text: str) -> None:
    """Raise BadInput for the path of a Python file without the name of a function. The file is read, not run."""
    if not text.endswith(".py"):
        return
    functions: list[str] = []
    with suppress(OSError, ValueError, SyntaxError):
        body = ast.parse(Path(text).read_bytes()).body
        public = (node for node in body if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"))
        functions = [node.name for node in public if _is_callable(node.args)]
    listed = f" Functions without arguments: {', '.join(functions)}." if functions else ""
    function = "build" if "build" in functions or not functions else functions[0]
    raise BadInput(
        f"filter {text!r} is a Python file: add the function that returns the filter, {text}:{function}.{listed}"
    )


def _is_callable(arguments: ast.arguments) -> bool:
    """Whether a function can be called without arguments."""
    positional = len(arguments.posonlyargs) + len(arguments.args)
    return positional == len(arguments.defaults) and None not in arguments.kw_defaults


def is_path(text: str) -> bool:
    """Whether the text is the path of a checkpoint rather than a filter name."""
    return text.endswith(".safetensors") or os.sep in text


def is_code(text: str) -> bool:
    """Whether the text names a build function: ``package.module:build`` or ``path/to/file.py:build[@WEIGHTS]``."""
    return ":" in text and (not text.endswith(".safetensors") or "@" in text.rpartition(":")[2])

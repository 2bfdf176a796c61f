"""Names of the built-in filters and their pretrained checkpoints. Without PyTorch: a wrong name is reported at once."""

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

RUNS = (".trace", ".live", ".rrd")
"""Endings of files with the trace of a run."""

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
    if not each:  # a log without sensors
        return {}
    return {key.format(modality=names[0]): (key, names) for key, kind in MODELS.items() for names in models[kind]}


def pretrained_path(task: str | Task, name: str) -> Path:
    """Path of the pretrained checkpoint of a task and filter. Raises BadInput if there is none."""
    check_not_source(name)
    definition = find_task(task)
    filters, task = filter_names(definition), definition.name
    paths = {filter_: PRETRAINED / f"{task}-{filter_}.safetensors" for filter_ in filters}
    is_built_in = task in TASKS and not difference(TASKS[task], definition)
    available = [filter_ for filter_, path in paths.items() if is_built_in and path.is_file()]
    if name not in filters:
        raise unknown_name("filter", name, available)
    if definition.rotations and name not in available:
        raise BadInput(f"{no_built_in(definition)}; give your own filter as FILE.py:FUNCTION")
    if name not in available and task not in TASKS:
        raise BadInput(
            f"no pretrained {name!r} for your own task {task!r}: train one (beliefscope train FILE.py:TASK --data "
            f"FILE.h5 --filter {name} -o FILE.safetensors) and give its file, or your own filter as FILE.py:FUNCTION."
        )
    if name not in available:
        raise BadInput(
            f"no pretrained {name!r} for task {task!r}; train one: beliefscope train {task} --filter {name}. "
            f"Available: {', '.join(available) or 'none'}."
        )
    return paths[name]


def no_built_in(task: Task) -> str | None:
    """Reason why the built-in filters cannot run over a task, whatever its sensors; None if they can."""
    if not task.rotations:
        return None
    name = task.components[task.rotations[0].start].rotation
    return f"built-in filters estimate vectors; task {task.name!r} has the rotation {name!r}"


def check_trainable(definition: Task, task: str, text: str) -> None:
    """Raise BadInput if ``train`` has no filter of this name, such as for a file or an external filter.

    definition: of the task. task: its name or source on the command line. text: the filter.
    """
    names = filter_names(definition)
    if text in names:
        if reason := no_built_in(definition):
            raise BadInput(reason)
        return
    is_external = text.endswith(".py") or is_code(text)
    if not (is_external or is_path(text)):
        raise unknown_name("filter", text, names)
    file = text.rpartition(":")[0] if is_code(text) else text
    if (file.endswith(".py") or is_path(file)) and not Path(file).is_file():
        problem = f"is not a filter that this command trains, and no file {file!r} exists"
    elif is_external:
        source = text if is_code(text) else f"{text}:{_build_function(_functions(text))}"
        problem = "is an external filter, which this command does not train; fine-tune it: "
        problem += f"beliefscope finetune {task} --filter {source} -o finetuned.safetensors (docs/finetune.md)"
    elif text.endswith(".safetensors"):
        problem = f"is a checkpoint; fine-tune it: beliefscope finetune {text} -o finetuned.safetensors"
    else:
        problem = "is not a filter that this command trains"
    raise BadInput(f"filter {text!r} {problem}. Filters that can be trained: {', '.join(names)}.")


def check_not_source(text: str) -> None:
    """Raise BadInput for the path of a Python file without the name of a function. The file is read, not run."""
    if not text.endswith(".py"):
        return
    if not Path(text).is_file():
        raise BadInput(f"filter {text!r} does not exist: expected a file and its function, such as {text}:build.")
    functions = _functions(text)
    listed = f" Functions without arguments: {', '.join(functions)}." if functions else ""
    function = _build_function(functions)
    raise BadInput(
        f"filter {text!r} is a Python file: add the function that returns the filter, {text}:{function}.{listed}"
    )


def _functions(path: str) -> list[str]:
    """Names of the public functions of a Python file without required arguments; none for other files."""
    with suppress(OSError, ValueError, SyntaxError):
        body = ast.parse(Path(path).read_bytes()).body
        public = (node for node in body if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"))
        return [node.name for node in public if _is_callable(node.args)]
    return []


def _build_function(functions: list[str]) -> str:
    """The function that probably returns the filter: ``build``, or the first one."""
    return "build" if "build" in functions or not functions else functions[0]


def _is_callable(arguments: ast.arguments) -> bool:
    """Whether a function can be called without arguments."""
    positional = len(arguments.posonlyargs) + len(arguments.args)
    return positional == len(arguments.defaults) and None not in arguments.kw_defaults


def is_path(text: str) -> bool:
    """Whether the text is the path of a checkpoint, rather than a filter name or a build function."""
    return not is_code(text) and (text.endswith(".safetensors") or os.sep in text)


def is_source(text: str) -> bool:
    """Whether the text is the path of a checkpoint or names a build function, rather than a built-in filter."""
    return is_path(text) or is_code(text)


def is_run(text: str) -> bool:
    """Whether the text is the path of a recorded run, or of a folder with some, rather than a name."""
    if text.endswith(RUNS):
        return True
    return text not in TASKS and Path(text).is_dir() and any(file.suffix in RUNS for file in Path(text).iterdir())


def is_code(text: str) -> bool:
    """Whether the text names a build function: ``MODULE:FUNCTION`` or ``FILE.py:FUNCTION[@WEIGHTS]``."""
    return ":" in text and (not text.endswith(".safetensors") or "@" in text.rpartition(":")[2])


def code_parts(source: str) -> tuple[str, str, str]:
    """File or module, function, and weights or an empty text, of ``FILE.py:FUNCTION[@WEIGHTS]``."""
    place, _, attribute = source.rpartition(":")
    function, _, weights = attribute.partition("@")
    return place, function, weights


def external_name(source: str) -> str:
    """Name of the external filter that ``FILE.py:FUNCTION[@WEIGHTS]`` or ``MODULE:FUNCTION[@WEIGHTS]`` builds."""
    place, function, weights = code_parts(source)
    names = [Path(place).stem if place.endswith(".py") else place, function, Path(weights).stem]
    return "-".join(filter(None, names))

"""Command-line options shared by several commands, and functions that open checkpoints, episodes and traces."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_origin, get_type_hints

import typer
from typer.models import ParameterInfo

from beliefscope.app.cli import console
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.parallel import prepare_processes
from beliefscope.datasets.text import plural

if TYPE_CHECKING:
    from beliefscope.datasets.dataset import Dataset
    from beliefscope.datasets.episode import Episode
    from beliefscope.datasets.faults.injection import Faults
    from beliefscope.datasets.task import Task
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace


def integer(minimum: int, maximum: int | None = None) -> Callable[[str], int]:
    """Parser for integer options. Unlike typer's range check, its error shows the rejected value."""
    valid = f"of at least {minimum}" if maximum is None else f"from {minimum} to {maximum}"

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = minimum - 1
        if value < minimum or (maximum is not None and value > maximum):
            raise typer.BadParameter(f"{text!r} is not an integer {valid}")
        return value

    return parse


URL = "http://127.0.0.1:8000"
"""Default address of ``beliefscope serve``."""

Quantity = Literal["likelihood", "posterior"]
Engine = Literal["local", "ray"]


def prepare_workers(engine: Engine, workers: int, module: str) -> None:
    """Begin to import the module that the worker processes will run, if there are any on this machine."""
    if engine == "local" and workers > 1:
        prepare_processes(module)


MAX_NAME = 255
"""Bytes of the name of a file in the file systems of Linux, macOS and Windows."""


def check_output(path: Path | None, *suffixes: str) -> Path | None:
    """The path of an output file. Raises BadInput if it cannot be written, or has not one of the suffixes."""
    if path is None:
        return None
    if (size := len(os.fsencode(path.name))) > MAX_NAME:
        raise BadInput(f"output {path.name[:40]!r}... has a name of {size} bytes, expected {MAX_NAME} at most")
    if path.is_dir():
        raise BadInput(f"output {str(path)!r} is a folder; give the name of a file in it")
    if suffixes and path.suffix.lower() not in suffixes:
        raise BadInput(f"output {str(path)!r} must end in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise BadInput(f"folder {str(path.parent)!r} does not exist, so {path.name!r} cannot be written in it")
    if not os.access(path.parent, os.W_OK):
        raise BadInput(f"folder {str(path.parent)!r} is not writable")
    return path


def _check_json(value: str | None) -> str | None:
    if value not in (None, "-"):
        raise BadInput(f"--json {value!r}: JSON is printed to standard output only; write --json -")
    return value


def option(metavar: str, description: str, default: Any = ..., *names: str, **settings: Any) -> Any:
    """An option with a value. default: ``...`` for none. names: default: ``--`` and the parameter's name.

    settings: of ``typer.Option``.
    """
    return typer.Option(default, *names, metavar=metavar, help=description, **settings)


def argument(metavar: str, description: str) -> Any:
    """A positional argument."""
    return typer.Argument(metavar=metavar, help=description)


def flag(description: str, *names: str, default: Any = False) -> Any:
    """An option without a value."""
    return typer.Option(default, *names, help=description)


def _check_checkpoint(path: Path) -> Path:
    """The path of a checkpoint to write. Raises BadInput if one exists, before work that would end in its loss."""
    check_output(path, ".safetensors")
    if path.exists():
        raise BadInput(f"output {str(path)!r} exists; give the name of a new file, or delete it first")
    return path


def output_file(
    metavar: str, description: str, *suffixes: str, names: Sequence[str] = ("-o", "--output"), default: Any = None
) -> Any:
    """An option for a file to write, by default ``-o``, checked before the command runs: another suffix is refused."""
    return option(metavar, description, default, *names, callback=lambda path: check_output(path, *suffixes))


DATASET = output_file("FILE.h5", "Output HDF5 file.", ".h5", ".hdf5", default=...)
CHECKPOINT = option(
    "CHECKPOINT", "Output .safetensors file; must not exist.", ..., "-o", "--output", callback=_check_checkpoint
)
TRACE_FILTER = option(
    "NAME|CHECKPOINT|FILE.py:FUNCTION",
    "Filter that produced the traces. Default: the pretrained filter with the traces' checkpoint hash.",
    "",
)

TASK_OF_FILES = option(
    "NAME|FILE.py:NAME",
    "Task of the files. They contain its definition, so this option is needed only for the functions of your own task "
    "(replay, outline), and for files of earlier versions without a definition.",
    "",
    "--task",
)

OPTIONS: dict[str, Any] = {
    "task": argument(
        "TASK",
        "Task: door, push, door-field, push-field, push-field-yaw, push-real or a variant of it (docs/data.md), or "
        "your own as FILE.py:NAME. The name is enough if --data or a checkpoint contains the definition.",
    ),
    "filter": option(
        "NAME|CHECKPOINT|FILE.py:FUNCTION",
        "Pretrained filter such as crossmodal-pf, path of a .safetensors file, or external filter given by its "
        "build function: FILE.py:FUNCTION or MODULE:FUNCTION (docs/own_filter.md).",
    ),
    "data": option(
        "FILE.h5|DIR",
        "Episodes: a Beliefscope HDF5 file or a supported external format (docs/data.md). "
        "Default: the sample set of the task.",
    ),
    "skip_bad": flag("Skip unusable episodes and report the reasons.", "--skip-bad", default=...),
    "episode": option("I", "Index of the episode in the data set. Default: the first held-out one.", parser=integer(0)),
    "faults": option(
        "FAULTS",
        "Sensor faults to inject, such as blackout=0.4,force_bias:x=5:from=20; also JSON or a .json file. "
        "List them with: beliefscope faults.",
    ),
    "slices": option(
        "SLICE",
        "Data slice: 'contact', 'free motion', 'blackout 0.8', 'haptics only', or a custom one, "
        "NAME:faults=FAULTS:contact=yes:only=MODALITY. Repeatable.",
        ...,
        "--slice",
    ),
    "quantity": option(
        "likelihood|posterior",
        "Quantity of the maps: likelihood of each observation, or posterior of the state. Default: likelihood, or "
        "posterior for an external filter that reports no virtual observations.",
        ...,
        "--map",
    ),
    "particles_kept": option(
        "M",
        "Maximum number of particles stored in each step; means and covariances are those of all particles.",
        parser=integer(1),
    ),
    "particles": option("M", "Number of particles (particle filters).", parser=integer(1)),
    "seed": option("S", "Random seed.", parser=integer(0)),
    "train": option(
        "PRESET|PATTERN",
        "Train only these modules: haptics-only, image-only, weights-only, noise-only, reliability-only, "
        "dynamics-only, heads-only, all, or patterns. Repeatable. Default: all modules that are not frozen.",
    ),
    "freeze": option("PATTERN", "Freeze these modules: dotted names, * matches any text. Repeatable."),
    "workspace": option("DIR", "Workspace folder for recordings and traces; created if missing."),
    "log": option("DIR", "Folder for TensorBoard logs.", callback=lambda path: check_folder(path, "--log")),
    "every": flag("Use all episodes, not only the held-out ones.", "--all", default=...),
    "by": option(
        "SCORE",
        "Score: error (position), the name of an angle, nees, ess (effective sample size), disagreement (of the "
        "modalities) or regret (of the fusion weights).",
    ),
    "engine": option("NAME", "local: processes of this machine. ray: a Ray cluster (pip install 'beliefscope[ray]')."),
    "workers": option("N", "Number of processes on this machine; the results do not depend on it.", parser=integer(1)),
    "align": flag(
        "Move data of another frame by the constant offset that explains the difference.", "--align", default=...
    ),
    "json": option("-", "Print one JSON document instead of text.", callback=_check_json),
}
"""Parameter of a command -> its description, where the command has no own one."""


def with_options(command: Callable[..., console.Result | None]) -> Callable[..., None]:
    """The command as typer runs it: prints its result, with option ``--json``.

    The default of a parameter is its description, or a plain value, with a description in its type or ``OPTIONS``. A
    parameter whose type is a dataclass, such as ``Run``, stands for an option for each of its fields.
    """
    hints = get_type_hints(command)
    has_result = hints.pop("return") is console.Result
    groups: dict[str, Any] = {name: type_ for name, type_ in hints.items() if is_dataclass(type_)}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        group = groups.get(name)
        parameters += inspect.signature(group).parameters.values() if group else [parameter]
        hints |= get_type_hints(group, include_extras=True) if group else {}
    if has_result:
        parameters.append(inspect.Parameter("json", inspect.Parameter.KEYWORD_ONLY, default=None))
        hints["json"] = str | None

    @wraps(command)
    def run(json: str | None = None, **values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in fields(group)})
        if (result := command(**values)) is not None:
            result.print(json)
            if result.code:
                raise typer.Exit(result.code)

    for parameter in parameters:
        name = parameter.name
        if not (isinstance(parameter.default, ParameterInfo) or get_origin(hints[name]) is Annotated):
            hints[name] = Annotated[hints[name], OPTIONS[name]]
    keywords = [p.replace(kind=p.KEYWORD_ONLY, annotation=hints[p.name]) for p in parameters]
    run.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in keywords}
    return run


@dataclass(frozen=True)
class Runs:
    """Options of a command that runs a filter over the episodes of a dataset."""

    task: str
    filter: str
    data: Path | None = None
    skip_bad: bool = False
    faults: str = ""
    particles: int = 300
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises BadInput for an unknown name of a task or pretrained filter, before a command imports PyTorch."""
        from beliefscope.datasets.catalog import TASKS
        from beliefscope.filters.names import is_source, pretrained_path

        has_definition = self.task not in TASKS and (":" in self.task or self.data is not None)
        if not (has_definition or is_source(self.filter)):
            pretrained_path(self.task, self.filter)

    def open(self) -> tuple[Checkpoint, Faults]:
        """The filter, and the faults to inject."""
        from beliefscope.datasets.faults.injection import read_faults
        from beliefscope.filters.open_filter import open_filter

        checkpoint = open_filter(definition_of(self.task, self.data), self.filter)
        return checkpoint, read_faults(self.faults, checkpoint.task)

    def settings(self, faults: Faults) -> dict[str, Any]:
        """Arguments that all functions that run a filter over episodes have."""
        return {"faults": faults, "seed": self.seed, "particles": self.particles}

    def episodes(self, task: Task) -> Dataset:
        """The dataset."""
        return open_episodes(task, self.data, self.skip_bad)

    def check(self, checkpoint: Checkpoint, episodes: list[Episode], align: bool) -> list[Episode]:
        """Warn if the episodes differ from the training data; with ``align``, the episodes in its frame."""
        from beliefscope.filters.alignment import align as move
        from beliefscope.filters.out_of_distribution import data_warning

        if align:
            episodes, alignment = move(checkpoint, episodes, self.particles, self.seed)
            console.note(f"aligned: {alignment}" if alignment else "aligned: the positions need no offset")
        if warning := data_warning(checkpoint, episodes):
            console.note(f"Warning: {warning}")
        return episodes


@dataclass(frozen=True)
class Run(Runs):
    """Options of a command that runs a filter over one episode."""

    episode: int | None = None

    def index(self, episodes: Dataset) -> int:
        """Index of the selected episode, or of the first held-out one."""
        return episodes.held_out()[0] if self.episode is None else self.episode

    def read_episode(self, task: Task) -> tuple[Episode, int]:
        """The selected episode, and its index."""
        with self.episodes(task) as episodes:
            return episodes[self.index(episodes)], self.index(episodes)

    def over(
        self, checkpoint: Checkpoint, episode: Episode, index: int, faults: Faults, align: bool = False, **settings: int
    ) -> Trace:
        """Run the filter over an episode with a progress bar. settings: further ones of ``trace``."""
        from beliefscope.inspect.trace import trace

        (episode,) = self.check(checkpoint, [episode], align)
        with console.progress("Filtering") as advance:
            return trace(checkpoint, episode, index, self.seed, self.particles, faults, advance, **settings)


def definition_of(task: str, path: Path | None) -> Task | str:
    """The task of the data if it is named and not a built-in one, so that the file that defines it is not needed."""
    from beliefscope.datasets.catalog import TASKS
    from beliefscope.datasets.store import open_dataset

    if path is None or task in TASKS or ":" in task:
        return task
    with open_dataset(path) as data:
        return data.task if data.task.name == task else task


def own_definitions(paths: Iterable[Path]) -> dict[str, Task]:
    """Name -> task of the data sets whose task is not a built-in one. Files that cannot be read have none."""
    from beliefscope.datasets.catalog import TASKS
    from beliefscope.datasets.store import open_dataset

    tasks: dict[str, Task] = {}
    for path in paths:
        with suppress(BadInput), open_dataset(path) as data:
            if data.task.name not in TASKS:
                tasks.setdefault(data.task.name, data.task)
    return tasks


def key_values(texts: Iterable[str], name: str, example: str) -> dict[str, str]:
    """Values by key of texts such as ``step=68``. name: of the option. Raises BadInput for other texts."""
    values: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key or not value:
            raise BadInput(f"{name} {text!r} is not {example}")
        if key in values:
            raise BadInput(f"{name} is given twice for {key!r}")
        values[key] = value
    return values


def check_folder(path: Path | None, option: str) -> Path | None:
    """The path of a folder. Raises BadInput if it is a file."""
    if path is not None and path.exists() and not path.is_dir():
        raise BadInput(f"{option} {str(path)!r} is a file; give the name of a folder")
    return path


def check_url(url: str) -> None:
    """Raise BadInput if it is not the address of a server."""
    if not url.startswith(("http://", "https://")):
        raise BadInput(f"--url {url!r} is not an address such as {URL}")


def check_workspace(workspace: Path) -> None:
    """Raise BadInput if the workspace is a file or cannot be created."""
    if workspace.exists() and not workspace.is_dir():
        raise BadInput(f"workspace {str(workspace)!r} is a file, not a folder")
    if not workspace.absolute().parent.is_dir():
        raise BadInput(f"folder {str(workspace.parent)!r} does not exist, so {workspace.name!r} cannot be created")


def open_episodes(task: Task, path: Path | None, skip_bad: bool = False) -> Dataset:
    """Open a data set (default: the sample set) and print skipped episodes. Raises BadInput for another task."""
    from beliefscope.datasets.store import open_dataset, sample_path
    from beliefscope.datasets.task_json import difference

    data = open_dataset(sample_path(task) if path is None else path, task, skip_bad)
    if other := difference(task, data.task):
        data.close()
        raise BadInput(f"{str(path)!r} contains episodes of {other}, not of {task.name!r}")
    for line in data.skipped:
        console.note(f"skipped: {line}")
    return data


def trace_result(trace: Trace, path: Path, **extra: Any) -> console.Result:
    """Description of a file created from a trace. extra: values of the JSON document, besides those of the trace."""
    from beliefscope.inspect.traces.provenance import describe

    document = describe(trace) | extra
    steps = plural(document["steps"], "step")
    run = f"{trace.filter} over {steps} of {trace.task.name} episode {trace.episode_index}"
    return console.Result(document, run + (f" with {trace.faults}" if trace.faults else ""), path)

"""Shared command-line options, and functions that resolve their values to checkpoints, episodes and traces."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.runs.command_lines import is_code, is_path
from beliefscope.datasets.errors import BadInput

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


def _check_json(value: str | None) -> str | None:
    if value not in (None, "-"):
        raise BadInput(f"--json {value!r}: JSON is printed to standard output only; write --json -")
    return value


TaskName = Annotated[
    str, typer.Argument(metavar="TASK", help="Task: door, push, push-real, a variant, or your own (docs/data.md).")
]
FilterName = Annotated[
    str,
    typer.Option(
        "--filter",
        metavar="NAME|CHECKPOINT|MODULE:BUILD",
        help="Built-in filter such as crossmodal-pf, path of a .safetensors file, or external filter given by its "
        "build function: package.module:build or path/to/file.py:build (docs/own_filter.md).",
    ),
]
TraceFilter = Annotated[
    str,
    typer.Option(
        "--filter",
        metavar="NAME|CHECKPOINT",
        help="Filter that produced the traces. Default: the built-in filter with the traces' checkpoint hash.",
    ),
]
DataPath = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.h5|DIR",
        help="Episodes: a Beliefscope HDF5 file or a supported external format (docs/data.md). "
        "Default: the built-in sample dataset.",
    ),
]
SkipBad = Annotated[bool, typer.Option("--skip-bad", help="Skip unusable trajectories and report the reasons.")]
EpisodeIndex = Annotated[
    int | None,
    typer.Option(
        parser=integer(0), metavar="I", help="Index of the episode in the dataset. Default: the first held-out one."
    ),
]
FaultsText = Annotated[
    str,
    typer.Option(
        "--faults",
        metavar="FAULTS",
        help="Sensor faults to inject, such as blackout=0.4,force_bias:x=5:from=20; also JSON or a .json file. "
        "List them with: beliefscope faults.",
    ),
]
SliceTexts = Annotated[
    list[str] | None,
    typer.Option(
        "--slice",
        metavar="SLICE",
        help="Data slice: 'contact', 'free motion', 'blackout 0.8', 'haptics only', or a custom one, "
        "NAME:faults=FAULTS:contact=yes:only=MODALITY. Repeatable.",
    ),
]
Particles = Annotated[int, typer.Option(parser=integer(1), metavar="M", help="Number of particles (particle filters).")]
Seed = Annotated[int, typer.Option(parser=integer(0), metavar="S", help="Random seed.")]
Workspace = Annotated[
    Path, typer.Option(metavar="DIR", help="Workspace folder for recordings and traces; created if missing.")
]
LogFolder = Annotated[Path | None, typer.Option("--log", metavar="DIR", help="Folder for TensorBoard logs.")]
FigurePath = Annotated[
    Path, typer.Option("-o", "--output", metavar="FIGURE", help="Output figure: .svg, .pdf or .png.")
]
CheckpointPath = Annotated[Path, typer.Option("-o", "--output", metavar="CHECKPOINT", help="Output .safetensors file.")]
DatasetPath = Annotated[Path, typer.Option("-o", "--output", metavar="FILE.h5", help="Output HDF5 file.")]
TracePath = Annotated[Path, typer.Option("-o", "--output", metavar="TRACE", help="Output trace file.")]
Json = Annotated[
    str | None,
    typer.Option(metavar="-", callback=_check_json, help="Print one JSON document instead of text: --json -"),
]


def check_output(path: Path | None) -> None:
    """Raise BadInput early if the output file cannot be written."""
    if path is None:
        return
    if path.is_dir():
        raise BadInput(f"output {str(path)!r} is a folder; give the name of a file in it")
    if not path.parent.is_dir():
        raise BadInput(f"folder {str(path.parent)!r} does not exist, so {path.name!r} cannot be written in it")
    if not os.access(path.parent, os.W_OK):
        raise BadInput(f"folder {str(path.parent)!r} is not writable")


def check_folder(path: Path | None, option: str) -> None:
    """Raise BadInput if the path of a folder is a file."""
    if path is not None and path.exists() and not path.is_dir():
        raise BadInput(f"{option} {str(path)!r} is a file; give the name of a folder")


def check_workspace(workspace: Path) -> None:
    """Raise BadInput if the workspace is a file or cannot be created."""
    if workspace.exists() and not workspace.is_dir():
        raise BadInput(f"workspace {str(workspace)!r} is a file, not a folder")
    if not workspace.absolute().parent.is_dir():
        raise BadInput(f"folder {str(workspace.parent)!r} does not exist, so {workspace.name!r} cannot be created")


def open_episodes(task: Task, path: Path | None, skip_bad: bool = False) -> Dataset:
    """Open a dataset (default: the sample dataset) and print skipped trajectories. Raises BadInput for another task."""
    from beliefscope.datasets.store import open_dataset, sample_path

    data = open_dataset(sample_path(task.name) if path is None else path, task, skip_bad)
    if data.task.name != task.name:
        data.close()
        raise BadInput(f"{str(path)!r} contains episodes of task {data.task.name!r}, not of {task.name!r}")
    for line in data.skipped:
        console.note(f"skipped: {line}")
    return data


def open_checkpoint(task: str, name_or_path: str) -> Checkpoint:
    """Load a built-in filter by name, a checkpoint by path, or an external filter by ``module:build``."""
    from beliefscope.datasets.catalog import load_task
    from beliefscope.filters.checkpoint import load_checkpoint, shipped

    name = load_task(task).name
    if is_code(name_or_path):
        from beliefscope.filters.external.load import load_external

        return load_external(name_or_path, name)
    checkpoint = load_checkpoint(Path(name_or_path) if is_path(name_or_path) else shipped(name, name_or_path))
    if checkpoint.task.name != name:
        raise BadInput(f"filter {name_or_path!r} is for task {checkpoint.task.name!r}, not for {name!r}")
    return checkpoint


def open_recording(path: Path) -> Trace:
    """Read the trace in a recording or a live file. A separate process checks the recording first (it may crash)."""
    from beliefscope.app.workspace.recording_probe import RecordingProbe
    from beliefscope.inspect.traces.live_file import SUFFIX, load_live
    from beliefscope.recordings.read import read_recording

    if path.suffix == SUFFIX:
        return load_live(path)
    if path.is_file():
        metadata = RecordingProbe()(path)
        if metadata.problem and not metadata.application:
            raise BadInput(f"{path}: {metadata.problem}")
    return read_recording(path)


def open_trace(path: Path) -> Trace:
    """Read a trace from a trace file, a recording or a live file."""
    from beliefscope.inspect.trace import load_trace

    return open_recording(path) if path.suffix in (".rrd", ".live") else load_trace(path)


def open_traces(paths: Sequence[Path], filter_: str) -> tuple[list[Trace], Checkpoint | None]:
    """Read traces of one filter, and its checkpoint if available.

    Args:
        filter_: name or path of the filter; if empty, the built-in filter with the traces' checkpoint hash.

    Raises:
        BadInput: the traces are of different checkpoints, or not of the given filter.
    """
    from beliefscope.datasets.catalog import find_task
    from beliefscope.filters.checkpoint import load_checkpoint, shipped

    traces = [open_trace(path) for path in paths]
    first = traces[0]
    for path, trace in zip(paths, traces, strict=True):
        if trace.checkpoint_hash != first.checkpoint_hash:
            raise BadInput(f"{path} and {paths[0]} are from different checkpoints; give traces of one filter")
    if filter_:
        checkpoint = open_checkpoint(find_task(first.episode.task).name, filter_)
        if checkpoint.hash != first.checkpoint_hash:
            raise BadInput(f"{paths[0]} is from checkpoint {first.checkpoint_hash[:12]}, not from {filter_!r}")
        return traces, checkpoint
    try:
        checkpoint = load_checkpoint(shipped(first.episode.task, first.filter))
    except BadInput:
        return traces, None
    return traces, checkpoint if checkpoint.hash == first.checkpoint_hash else None


def read_faults(text: str) -> str:
    """The contents of a faults file if the text is a path (ends in .json or has a separator), else the text itself."""
    if text.lstrip().startswith(("{", "[")) or not (text.endswith(".json") or os.sep in text):
        return text
    try:
        return Path(text).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise BadInput(f"faults {text!r} is not a readable file") from None


def parse_faults(text: str, task: Task) -> Faults:
    """Parse the value of --faults. Raises BadInput for faults that do not apply to the task."""
    from beliefscope.datasets.faults.injection import Faults

    faults = Faults.parse(read_faults(text))
    faults.check(task)
    return faults


def select_episode(task: Task, data: Path | None, skip_bad: bool, index: int | None) -> tuple[Episode, int]:
    """The episode with this index, or the first held-out one; and its index."""
    with open_episodes(task, data, skip_bad) as episodes:
        index = episodes.held_out()[0] if index is None else index
        return episodes[index], index


def run_filter(
    task: TaskName,
    filter_: FilterName,
    data: DataPath = None,
    skip_bad: SkipBad = False,
    episode: EpisodeIndex = None,
    faults_: FaultsText = "",
    particles: Particles = 300,
    seed: Seed = 0,
) -> tuple[Checkpoint, Trace]:
    """Run a filter over one episode with a progress bar; returns its checkpoint and the trace."""
    from beliefscope.inspect.trace import trace

    checkpoint = open_checkpoint(task, filter_)
    faults = parse_faults(faults_, checkpoint.task)
    recorded, index = select_episode(checkpoint.task, data, skip_bad, episode)
    with console.progress("Filtering") as advance:
        return checkpoint, trace(checkpoint, recorded, index, seed, particles, faults, advance)


def with_run_options(command: Callable[..., None]) -> Callable[..., None]:
    """Prepend the options of ``run_filter`` to those of a command.

    The command receives the checkpoint, the trace and its own options; ``output`` is checked before the run.
    """
    signatures = [inspect.signature(function) for function in (run_filter, command)]
    shared, other = (list(signature.parameters.values()) for signature in signatures)
    # The two classes are imported only when a command runs.
    names = {"Checkpoint": Any, "Trace": Any}
    hints = {
        k: v for f in (run_filter, command) for k, v in get_type_hints(f, None, names, include_extras=True).items()
    }
    options = [p.replace(kind=p.KEYWORD_ONLY, annotation=hints[p.name]) for p in (*shared, *other[2:])]

    @wraps(command)
    def run(**values: Any) -> None:
        check_output(values["output"])
        command(*run_filter(**{p.name: values.pop(p.name) for p in shared}), **values)

    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in options}
    return run


def print_trace(trace: Trace, path: Path, json: str | None, **extra: Any) -> None:
    """Print the description of a file created from a trace. extra: additional values of the JSON document."""
    document = {
        "task": trace.episode.task,
        "filter": trace.filter,
        "episode": trace.episode_index,
        "steps": len(trace),
        "faults": trace.faults.to_json(),
        "seed": trace.seed,
        "checkpoint_hash": trace.checkpoint_hash,
        "data_hash": trace.data_hash,
        "path": str(path),
        "bytes": path.stat().st_size,
    }
    run = f"{trace.filter} over {len(trace)} steps of {trace.episode.task} episode {trace.episode_index}"
    text = f"{path_and_size(path)}: {run}" + (f" with {trace.faults}" if trace.faults else "")
    console.result(document | extra, text, json)


def print_checkpoint(
    path: Path, task: str, name: str, digest: str, record: dict[str, Any], text: str, json: str | None
) -> None:
    """Print the description of a trained checkpoint. text: printed instead of the JSON document."""
    document = {"task": task, "filter": name, "checkpoint_hash": digest, "path": str(path)}
    console.result(document | {"bytes": path.stat().st_size, "record": record}, text, json)


def path_and_size(path: Path) -> str:
    """``run.trace (1.2 MB)``"""
    return f"{path} ({path.stat().st_size / 1e6:.1f} MB)"

"""What the commands are given: the options they share, and the things that names and paths stand for."""

from __future__ import annotations

import inspect
import os
import shlex
from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from beliefscope.app.cli import output as console
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.datasets.dataset import Dataset
    from beliefscope.datasets.episode import Episode
    from beliefscope.datasets.faults.injection import Faults
    from beliefscope.datasets.task import Task
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """Parser of an option's whole number. Unlike typer's own, it names the value that does not fit."""
    valid = f"of at least {least}" if most is None else f"from {least} to {most}"

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least or (most is not None and value > most):
            raise typer.BadParameter(f"{text!r} is not a whole number {valid}")
        return value

    return parse


TaskName = Annotated[
    str,
    typer.Argument(
        metavar="TASK",
        help="Name of the task: door, push, push-real; docs/data.md has its variants and how to add yours.",
    ),
]
FilterName = Annotated[
    str,
    typer.Option(
        "--filter",
        metavar="NAME|CHECKPOINT|MODULE:BUILD",
        help="A filter that ships trained, such as crossmodal-pf; the path of a .safetensors file; or one of your own, "
        "which package.module:build or path/to/file.py:build makes (docs/own_filter.md).",
    ),
]
DataPath = Annotated[
    Path | None,
    typer.Option(
        "--data",
        metavar="FILE.h5|DIR",
        help="Episodes to use: a file of ours, or files of others as in docs/data.md. "
        "Without it: the sample set that ships.",
    ),
]
SkipBad = Annotated[
    bool,
    typer.Option("--skip-bad", help="Leave out trajectories that cannot be used, and say which and why."),
]
EpisodeIndex = Annotated[
    int | None,
    typer.Option(
        "--episode",
        parser=whole(0),
        metavar="I",
        help="Index in the data set. Without it: the first that is held out.",
    ),
]
FaultsText = Annotated[
    str,
    typer.Option(
        "--faults",
        metavar="FAULTS",
        help="How the sensors are broken: blackout=0.4,force_bias:x=5:from=20, or JSON, or a .json file of it. "
        "beliefscope faults lists the faults.",
    ),
]
Particles = Annotated[int, typer.Option("--particles", parser=whole(1), metavar="M", help="Of a particle filter.")]
Seed = Annotated[int, typer.Option("--seed", parser=whole(0), metavar="S", help="All randomness comes from it.")]
Json = Annotated[
    str | None,
    typer.Option("--json", metavar="-", help="Print one JSON document to standard output instead of text."),
]


def check(output: Path | None, json: str | None) -> None:
    """Raises BadInput for what would otherwise only fail once the work is done."""
    if json not in (None, "-"):
        raise BadInput(f"--json {json!r}: the document goes to standard output, which is written --json -")
    if output is None:
        return
    if output.is_dir():
        raise BadInput(f"output {str(output)!r} is a folder; give the name of a file in it")
    if not output.parent.is_dir():
        raise BadInput(f"folder {str(output.parent)!r} does not exist, so {output.name!r} cannot be written in it")
    if not os.access(output.parent, os.W_OK):
        raise BadInput(f"folder {str(output.parent)!r} may not be written to")


def dataset(task: Task, path: Path | None, skip_bad: bool = False) -> Dataset:
    """The path's episodes, or the sample set's; says what is left out. Raises BadInput for those of another task."""
    from beliefscope.datasets.store import open_dataset, sample_path

    data = open_dataset(sample_path(task.name) if path is None else path, task, skip_bad)
    if data.task.name != task.name:
        data.close()
        raise BadInput(f"{str(path)!r} holds episodes of task {data.task.name!r}, not of {task.name!r}")
    for line in data.left_out:
        console.say(f"left out: {line}")
    return data


def checkpoint(task: str, name_or_path: str) -> Checkpoint:
    """A path ends in .safetensors or holds a separator; with a colon it is a filter from outside, to be made by the
    function behind it; anything else names a checkpoint that ships.
    """
    from beliefscope.datasets.catalog import load_task
    from beliefscope.filters.checkpoint import load_checkpoint, shipped

    known = load_task(task)
    if is_code(name_or_path):
        from beliefscope.filters.external.load import load_foreign

        return load_foreign(name_or_path, known.name)
    loaded = load_checkpoint(Path(name_or_path) if is_path(name_or_path) else shipped(known.name, name_or_path))
    if loaded.task.name != known.name:
        raise BadInput(f"filter {name_or_path!r} is for task {loaded.task.name!r}, not for {known.name!r}")
    return loaded


def recording_in(path: Path) -> Trace:
    """The run in a recording, or what there is of a live one.

    A damaged recording can end the process that reads it, so another one reads it before.
    """
    from beliefscope.app.workspace.recording_probe import Reader
    from beliefscope.inspect.traces.live_file import SUFFIX, load_live
    from beliefscope.recordings.read import read_recording

    if path.suffix == SUFFIX:
        return load_live(path)
    if path.is_file():
        about = Reader()(path)
        if about.problem and not about.application:
            raise BadInput(f"{path}: {about.problem}")
    return read_recording(path)


def trace_in(path: Path) -> Trace:
    """The run in a trace, a recording, or what there is of a live one."""
    from beliefscope.inspect.trace import load_trace

    return recording_in(path) if path.suffix in (".rrd", ".live") else load_trace(path)


def is_path(name_or_path: str) -> bool:
    """Whether a filter is named by its file."""
    return name_or_path.endswith(".safetensors") or os.sep in name_or_path


def is_code(name_or_path: str) -> bool:
    """Whether a filter is named as uvicorn names an app: ``package.module:build``, ``path/to/file.py:build``."""
    return ":" in name_or_path and not name_or_path.endswith(".safetensors")


def serving(filters: Iterable[str | Path], data: Path | None, seed: int) -> str:
    """The command whose page shows what was looked at; filters and data are those that do not ship."""
    given = ["--data", str(data)] if data else []
    given += [part for one in filters for part in ("--filter", str(one))]
    return shlex.join(["beliefscope", "serve", *given, *(["--seed", str(seed)] if seed else [])])


def faults_text(text: str) -> str:
    """What the file says, where the text is a path: it ends in .json or holds a separator."""
    if text.lstrip().startswith(("{", "[")) or not (text.endswith(".json") or os.sep in text):
        return text
    try:
        return Path(text).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise BadInput(f"faults {text!r} is not a file that can be read") from None


def faults(text: str, task: Task) -> Faults:
    """The faults that the text, or the file it names, stands for. Raises BadInput for one that does not fit."""
    from beliefscope.datasets.faults.injection import Faults

    found = Faults.parse(faults_text(text))
    found.check(task)
    return found


def of_one_run(command: Callable[..., None]) -> Callable[..., None]:
    """Puts the options that name one episode through one filter before a command's own.

    The command is called with the checkpoint, the trace, and its own options, among them ``output`` and ``json``, which
    are looked at before anything is computed.
    """
    signatures = [inspect.signature(function) for function in (one_run, command)]
    shared, own = (list(signature.parameters.values()) for signature in signatures)
    hints = _hints(one_run) | _hints(command)
    options = [p.replace(kind=p.KEYWORD_ONLY, annotation=hints[p.name]) for p in (*shared, *own[2:])]

    @wraps(command)
    def run(**values: Any) -> None:
        check(values["output"], values["json"])
        named = {p.name: values.pop(p.name) for p in shared}
        command(*one_run(**named), **values)

    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in options}
    return run


def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    # These two are not imported before a command runs.
    return get_type_hints(function, localns={"Checkpoint": Any, "Trace": Any}, include_extras=True)


def one_run(
    task: TaskName,
    filter_: FilterName,
    data: DataPath = None,
    skip_bad: SkipBad = False,
    episode: EpisodeIndex = None,
    faults_: FaultsText = "",
    particles: Particles = 300,
    seed: Seed = 0,
) -> tuple[Checkpoint, Trace]:
    """The checkpoint and the trace of one episode, with a bar. Without an index, of the first that is held out."""
    from beliefscope.inspect.trace import trace

    loaded = checkpoint(task, filter_)
    broken = faults(faults_, loaded.task)
    shown, index = one_episode(loaded.task, data, skip_bad, episode)
    with console.progress("Filtering") as advance:
        return loaded, trace(loaded, shown, index, seed, particles, broken, advance)


def one_episode(task: Task, data: Path | None, skip_bad: bool, index: int | None) -> tuple[Episode, int]:
    """That episode and its index; without one, the first that is held out."""
    with dataset(task, data, skip_bad) as episodes:
        index = episodes.held_out()[0] if index is None else index
        return episodes[index], index


def described(trace: Trace, path: Path) -> dict[str, Any]:
    """The JSON document of a file that was made from a trace."""
    return {
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


def title(trace: Trace, path: Path) -> str:
    """The same in one line of text."""
    what = f"{trace.filter} over {len(trace)} steps of {trace.episode.task} episode {trace.episode_index}"
    return f"{size(path)}: {what}" + (f" with {trace.faults}" if trace.faults else "")


def size(path: Path) -> str:
    return f"{path} ({path.stat().st_size / 1e6:.1f} MB)"

"""Checkpoints of studies and sweeps as filters. Their names identify them in any server with these results."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path

from beliefscope.app.runs.catalog import result_folders
from beliefscope.app.runs.settings import Settings
from beliefscope.app.workspace.studies import BUILT_IN, FILE, Study
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import PRETRAINED, Checkpoint, load_checkpoint

HASH_DIGITS = 8
"""Digits of the checkpoint's hash at the end of a name."""

NAME = re.compile(rf"(.+)-([0-9a-f]{{{HASH_DIGITS}}})", re.DOTALL)


def all_studies(folders: Mapping[str, Path], workspace: Path) -> list[Study]:
    """The studies given to the server by name, those in the workspace, and the built-in one."""
    named = result_folders(folders, workspace, FILE, BUILT_IN)
    return [*(Study(name, folder, True) for name, folder in named.items()), Study(BUILT_IN, PRETRAINED, False)]


def sweep_folders(settings: Settings) -> dict[str, Path]:
    """Folders of sweeps by name: those given to the server, and those in the workspace."""
    return result_folders(settings.sweeps, settings.workspace, "results.parquet")


def result_filter_name(name: str, hash_: str) -> str:
    """Name in the catalog. name: of the checkpoint in a sweep, or its cell in a study."""
    name = name.partition("/")[2].replace("/", "-") or name
    return f"{name}-{hash_[:HASH_DIGITS]}"


def find_result_filter(task: str, name: str, settings: Settings) -> Checkpoint | None:
    """The checkpoint of the server's sweeps and studies with a name from ``result_filter_name``; None if none has it.

    Raises BadInput if its file is missing or was changed after its evaluation.
    """
    problems = []
    for source, find, hash_ in _candidates(task, name, settings):
        try:
            path = find()
            loaded = load_checkpoint(path, settings.definitions)
            if loaded.hash == hash_:
                return loaded
            problem = f"checkpoint {str(path)!r} was changed after its evaluation, from {hash_[:12]}"
        except BadInput as error:
            problem = str(error)
        problems.append(f"filter {name!r} of {source}: {problem}")
    if problems:
        raise BadInput(problems[0])
    return None


def _candidates(task: str, name: str, settings: Settings) -> Iterator[tuple[str, Callable[[], Path], str]]:
    """Source, such as ``sweep 'lr'``, function that finds the file or raises BadInput, and hash of each checkpoint."""
    if (match := NAME.fullmatch(name)) is None:
        return
    for sweep, folder in sweep_folders(settings).items():
        from beliefscope.recordings.experiments import Experiments  # pyarrow and DuckDB are slow to import

        with suppress(BadInput):  # damaged tables; the list of sweeps reports them
            tables = Experiments([folder])
            query = "SELECT checkpoint FROM checkpoints WHERE task = ? AND name = ? AND starts_with(checkpoint, ?)"
            for row in tables.query(query, [task, *match.groups()]).to_pylist():
                hash_ = row["checkpoint"]
                yield f"sweep {sweep!r}", partial(tables.path, "checkpoints", "checkpoint", hash_), hash_
    for study in all_studies(settings.studies, settings.workspace):
        with suppress(BadInput):  # damaged results; the list of studies reports them
            for cell, hash_ in study.read().checkpoints.items() if study.has_checkpoints else ():
                if cell.startswith(f"{task}/") and result_filter_name(cell, hash_) == name:
                    yield f"study {study.name!r}", partial(study.checkpoint, cell), hash_

"""Checkpoints of studies as filters. Their names identify them in any server with the study, also after a restart."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path

from beliefscope.app.runs.catalog import result_folders
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.sweep_filters import HASH_DIGITS, NAME, Candidate
from beliefscope.app.workspace.studies import BUILT_IN, FILE, Study
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import PRETRAINED, Checkpoint, load_checkpoint


def all_studies(folders: Mapping[str, Path], workspace: Path) -> list[Study]:
    """The studies given to the server by name, those in the workspace, and the built-in one."""
    named = result_folders(folders, workspace, FILE, BUILT_IN)
    return [*(Study(name, folder, True) for name, folder in named.items()), Study(BUILT_IN, PRETRAINED, False)]


def study_filter_name(cell: str, hash_: str) -> str:
    """Name of a cell's checkpoint in the catalog, such as ``crossmodal-ekf-seed0-1f0c9d2e``."""
    _, filter_, seed = cell.split("/")
    return f"{filter_}-{seed}-{hash_[:HASH_DIGITS]}"


def load_study_filter(study: Study, cell: str, hash_: str, settings: Settings) -> Checkpoint:
    """Filter of a trained cell. Raises BadInput for a file that is missing or was changed."""
    path = study.checkpoint(cell)
    loaded = load_checkpoint(path, settings.definitions)
    if loaded.hash != hash_:
        raise BadInput(f"{str(path)!r} is not the checkpoint that study {study.name!r} evaluated")
    return loaded


def study_candidates(task: str, name: str, settings: Settings) -> Iterator[Candidate]:
    """The checkpoints of the server's studies with a name from ``study_filter_name``."""
    for study in all_studies(settings.studies, settings.workspace) if NAME.fullmatch(name) else ():
        checkpoints: Mapping[str, str] = {}
        if study.has_checkpoints:
            with suppress(BadInput):  # damaged results; the list of studies reports them
                checkpoints = study.read().checkpoints
        for cell, hash_ in checkpoints.items():
            if cell.startswith(f"{task}/") and study_filter_name(cell, hash_) == name:
                yield f"study {study.name!r}", partial(load_study_filter, study, cell, hash_, settings)

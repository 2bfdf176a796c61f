"""Datasets in HDF5: atomic writes and validated reads. The layout is described in docs/data.md."""

from __future__ import annotations

import copyreg
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import TASKS, find_task
from beliefscope.datasets.dataset import Dataset, EpisodeSummary
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.episode_index import read_index, write_index
from beliefscope.datasets.episode_parts import STEPS_PER_PART
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_error
from beliefscope.datasets.readers.episode_file import FORMAT, VERSION, EpisodeFile, combined, is_episode_file
from beliefscope.datasets.readers.hdf5_guard import (
    SAMPLES,
    DeferredErrorFile,
    mark_readable,
    probe,
)
from beliefscope.datasets.readers.mit_push import MitPushDataset, is_mit_push
from beliefscope.datasets.readers.paper_authors import PaperDataset, is_paper_file
from beliefscope.datasets.readers.push_real_task import PUSH_REAL, PUSH_REAL_TASKS
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import check_definition, difference, task_to_json

EXAMINED = 100
"""Files of a folder that are searched for data files; data sets of other formats have thousands."""

LISTED = 5
"""Data files of a folder that are named in a message."""


def sample_path(task: str | Task) -> Path:
    """Path of a task's sample dataset. Raises BadInput for an unknown task or one without samples."""
    task = find_task(task)
    if not has_sample(task):
        can_simulate = task.simulate is not None
        raise BadInput(
            f"Task {task.name!r} has no sample set. Give its data with --data"
            + (f": beliefscope collect {task.name} simulates some." if can_simulate else ".")
        )
    return _sample_file(task.name)


def has_sample(task: str | Task) -> bool:
    """Whether the task is a built-in one with a sample dataset."""
    task = find_task(task)
    return task.name in TASKS and not difference(TASKS[task.name], task) and _sample_file(task.name).exists()


def _sample_file(name: str) -> Path:
    return SAMPLES / f"{name}.h5"


def open_dataset(
    path: str | Path, task: Task | None = None, skip_bad: bool = False, given: Sequence[Task] = ()
) -> Dataset:
    """Open a dataset for reading; the format is detected.

    Args:
        path: HDF5 file written by ``write_dataset``; file or folder (searched recursively) of the MIT Push dataset;
            file or folder of the HDF5 files of the paper's authors.
        task: which of the ``push-real`` tasks to use for MIT Push files.
        skip_bad: skip unusable episodes and list them in ``Dataset.skipped``.
        given: user-defined tasks, as for ``stored_task``; ``task`` is one of them.

    Raises:
        BadInput: if the data are missing, damaged, of an unknown format or unusable.
    """
    path = Path(path)
    files = data_files(path)
    if read_index(path) is not None:
        mark_readable(path)  # it was read completely when the index was written
    probe(files)
    if path.is_dir() and (own := list(filter(is_episode_file, files[:EXAMINED]))):
        raise BadInput(f"{path} is a folder: give one of its data files, {_listed(own, path)}.")
    if is_mit_push(files[0]):
        return MitPushDataset(path, files, task if task in PUSH_REAL_TASKS else PUSH_REAL, skip_bad)
    if is_paper_file(files[0]):
        return PaperDataset(path, files, skip_bad)
    if path.is_dir():
        raise BadInput(f"{path} is a folder without a data file of Beliefscope: expected FILE.h5 (docs/data.md).")
    return EpisodeFile(path, skip_bad, given if task is None else (task, *given))


def data_files(path: Path) -> list[Path]:
    """The file itself, or the data files of a folder. Raises BadInput if there is none."""
    if not path.exists():
        raise BadInput(f"{path} does not exist.")
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.rglob("*") if file.suffix in (".json", ".h5", ".hdf5") and file.is_file())
    if not files:
        raise BadInput(
            f"folder {path} has no data: expected a data file, or a folder of files that end in .json, .h5 or .hdf5."
        )
    return files


def _listed(files: Sequence[Path], folder: Path) -> str:
    names = [str(file.relative_to(folder)) for file in files]
    more = len(names) - LISTED
    return ", ".join(names[:LISTED]) + (f" and {more} more" if more > 0 else "")


def _reduce(data: Dataset) -> tuple[Any, ...]:
    """For other processes, which open the file themselves."""
    return open_dataset, (data.path, data.task, bool(data.skipped))


for _kind in (EpisodeFile, MitPushDataset, PaperDataset):
    copyreg.pickle(_kind, _reduce)


def write_dataset(path: str | Path, task: Task, episodes: Iterable[Episode]) -> None:
    """Write episodes to a file, which is replaced atomically, and its index. The same episodes give the same bytes.

    Raises BadInput, and writes nothing, if the definition of the task is inconsistent or the file cannot be written.
    """
    path = Path(path)
    check_definition(task)  # otherwise the file could not be opened
    if not path.parent.is_dir():
        raise BadInput(f"Folder {path.parent} does not exist: cannot write {path.name} there.")
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    summaries: list[EpisodeSummary] = []
    digests: list[str] = []
    try:
        with DeferredErrorFile(partial, "w+b") as output:
            with h5py.File(output, "w", libver=("v110", "v110")) as file:
                file.attrs["format"], file.attrs["version"], file.attrs["task"] = FORMAT, VERSION, task.name
                file.attrs["definition"] = json.dumps(task_to_json(task))
                for index, episode in enumerate(episodes):
                    group = file.create_group(f"trajectory{index}")
                    _write_episode(group, episode)
                    output.check()
                    summaries.append(
                        EpisodeSummary(
                            index=index,
                            steps=len(episode),
                            policy=str(episode.provenance.get("policy", "")),
                            split=episode.split,
                            seed=int(episode.seed),
                            contact_fraction=group.attrs["contact_fraction"],
                        )
                    )
                    digests.append(group.attrs["digest"])
            output.check()
        os.replace(partial, path)
        mark_readable(path)
        write_index(path, tuple(summaries), combined(digests))
    except OSError as error:
        partial.unlink(missing_ok=True)  # before the free space is measured
        raise write_error(path, error) from None
    finally:
        partial.unlink(missing_ok=True)


def _write_episode(group: h5py.Group, episode: Episode) -> None:
    group.attrs["seed"] = episode.seed
    group.attrs["split"] = episode.split
    group.attrs["dt"] = episode.dt
    group.attrs["contact_fraction"] = float(episode.contact.mean())
    group.attrs["provenance"] = json.dumps(dict(episode.provenance), sort_keys=True)
    group.attrs["digest"] = episode.digest()
    arrays: dict[str, NDArray[Any]] = {"states": episode.states, "controls": episode.controls, "qpos": episode.qpos}
    arrays["contact"] = episode.contact.astype(np.uint8)
    arrays |= {f"observations/{key}": value for key, value in episode.observations.items()}
    arrays |= {f"covariates/{key}": value for key, value in episode.covariates.items()}
    arrays |= {} if episode.time is None else {"time": episode.time}
    for key, array in arrays.items():
        # One HDF5 element per step: the shuffle filter then orders the bytes of each pixel or component by time,
        # which makes the images a fifth smaller.
        if not array.size:
            group.create_dataset(key, data=array)  # no joint positions without replay
            continue
        rows = (min(len(array), STEPS_PER_PART),)
        element = np.dtype((array.dtype, array.shape[1:])) if array.ndim > 1 else array.dtype
        stored = group.create_dataset(
            key, (len(array),), element, chunks=rows, compression="gzip", compression_opts=9, shuffle=True
        )
        stored[...] = array

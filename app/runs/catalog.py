"""Catalog of filters and data sets by task: the user's own first, then pretrained filters and sample data."""

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from beliefscope.app.workspace.saved_filters import SavedFilters
from beliefscope.datasets import episode_list
from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.faults.injection import Faults, available_presets
from beliefscope.datasets.initial_view import initial_view
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters.catalog import filters_of
from beliefscope.filters.checkpoint import Checkpoint, DeferredCheckpoint, load_checkpoint, pretrained_path
from beliefscope.filters.external.load import load_external
from beliefscope.filters.names import external_name, is_code, is_path

SAMPLE = "sample"
"""Name of the sample data set of a task."""

PRETRAINED = frozenset(name for task in TASKS.values() for name in filters_of(task))
"""Names of the pretrained filters of all tasks."""

EXTERNAL = {"door": {"hand-on-arc": "beliefscope.filters.external.hand_on_arc:build"}}
"""Task -> external filters that are always listed: name -> source."""

DEFAULT_FILTERS = ("information-ekf", "crossmodal-pf")
"""The first of these that is pretrained for a task is listed first."""


@dataclass
class TaskCatalog:
    """Filters and data sets of one task by name. Pretrained filters and sample data are loaded on first use.

    saved: the saved filters of the workspace. opened: checkpoints of studies and sweeps.
    """

    task: Task
    saved: SavedFilters | None = None
    user_filters: dict[str, Checkpoint] = field(default_factory=dict)
    user_data: dict[str, Dataset] = field(default_factory=dict)
    opened: dict[str, Checkpoint] = field(default_factory=dict)

    @property
    def filters(self) -> dict[str, Checkpoint]:
        """The user's filters or the first included one, then saved and opened ones, then the other included ones."""
        saved = [] if self.saved is None else list(self.saved.of_task(self.task))
        filters = {entry.name: checkpoint for entry, checkpoint in saved if entry.default} | self.user_filters
        included = list(self._included.items())
        others = [(entry.name, checkpoint) for entry, checkpoint in saved]
        for name, checkpoint in (*(included[:1] if not filters else ()), *others, *self.opened.items(), *included):
            filters.setdefault(name, checkpoint)
        return filters

    @cached_property
    def _included(self) -> dict[str, Checkpoint]:
        """Pretrained filters, and external ones that are always listed."""
        filters: dict[str, Checkpoint] = {}
        for name in dict.fromkeys((*DEFAULT_FILTERS, *filters_of(self.task))):
            with suppress(BadInput):  # not every filter is pretrained
                filters[name] = _pretrained(pretrained_path(self.task, name))
        for name, source in EXTERNAL.get(self.task.name, {}).items():
            filters[name] = _external(source, self.task)
        return filters

    @cached_property
    def data(self) -> dict[str, Dataset]:
        data = dict(self.user_data)
        if SAMPLE not in data:
            with suppress(BadInput):  # not every task has sample data
                data[SAMPLE] = _sample(sample_path(self.task), self.task)
        return data

    def dataset(self, name: str) -> Dataset:
        """The data set with the name; the first one for an empty name. Raises BadInput for an unknown name."""
        if name not in self.data and (name or not self.data):
            raise unknown_name("data", name, self.data)
        return self.data[name or next(iter(self.data))]

    def episode(self, data: str, index: int) -> Episode:
        """Raises BadInput for an unknown data set or an index outside of it."""
        episodes = self.dataset(data)
        if not 0 <= index < len(episodes):
            raise BadInput(f"episode {index} does not exist. Available: 0 to {len(episodes) - 1}.")
        return episodes[index]

    @property
    def problem(self) -> str | None:
        """Reason why the task cannot be displayed; None if it can."""
        if not self.filters:
            return f"task {self.task.name!r} has no trained filter; add one with --filter FILE"
        if not self.data:
            return f"task {self.task.name!r} has no episodes; add a data set with --data FILE"
        return None

    def to_json(self) -> dict[str, Any]:
        """The task's entry in the page's catalog."""
        task, main = self.task, self.task.main_error
        return {
            "name": task.name,
            "components": [component.to_json() for component in task.components],
            "modalities": list(task.modalities),
            "dt": task.dt,
            "simulated": task.simulate is not None,
            "map": {"components": list(task.map_components), "half_width": task.map_half_width},
            "main": {
                "name": main.name,
                "key": main.key,
                "unit": main.unit,
                "scale": main.factor,
                "indices": main.indices,
            },
            "fault_presets": [
                {"name": name, "faults": text, "stored": str(Faults.parse(text))}
                for name, text in available_presets(task).items()
            ],
            "filters": [_filter_json(name, filter_) for name, filter_ in self.filters.items()],
            "data": [_data_json(name, data) for name, data in self.data.items()],
        }

    def close(self) -> None:
        """Close the user's data sets."""
        for data in self.user_data.values():
            data.close()


# These files do not change: the catalogs of a process share them.
_pretrained = cache(DeferredCheckpoint)
_sample = cache(open_dataset)
_external = cache(load_external)


def task_catalogs(
    checkpoints: Mapping[str, Path | Checkpoint],
    data: Mapping[str, Path],
    tasks: Sequence[Task] = (),
    saved: SavedFilters | None = None,
) -> tuple[dict[str, TaskCatalog], list[str]]:
    """Catalogs of all tasks, those with filters or data of the user first; and one line for each unusable input.

    checkpoints: displayed name -> checkpoint file, or a loaded filter. data: displayed name -> file or folder of
    episodes. tasks: user-defined tasks, as for ``stored_task``. saved: of the workspace.
    """
    catalogs: dict[str, TaskCatalog] = {}
    problems: list[str] = []
    for name, source in checkpoints.items():
        try:
            checkpoint = source if isinstance(source, Checkpoint) else load_checkpoint(source, tasks)
            _catalog_of(catalogs, checkpoint.task, saved, name).user_filters[name] = checkpoint
        except BadInput as error:
            problems.append(str(error).removesuffix("."))
    tasks_with_filters = [catalog.task for catalog in catalogs.values()]
    for name, path in data.items():
        try:
            episodes = open_dataset(path, given=tasks)
            initial_view(episodes)  # the page opens it there: damage of these episodes is a problem of the data set
            _catalog_of(catalogs, episodes.task, saved, name).user_data[name] = episodes
            # A file of the MIT Push data set fits several tasks: offer it for each one that the user has filters for.
            for task in tasks_with_filters:
                if task != episodes.task:
                    other = open_dataset(path, task)
                    if other.task == task:
                        catalogs[task.name].user_data[name] = other
                    else:
                        other.close()
        except BadInput as error:
            problems.append(str(error).removesuffix("."))
    displayed = {name for catalog in catalogs.values() if not catalog.problem for name in catalog.user_data}
    for catalog in catalogs.values():
        if catalog.problem and (catalog.user_filters or catalog.user_data.keys() - displayed):
            problems.append(catalog.problem)
    for name, task in TASKS.items():
        catalogs.setdefault(name, TaskCatalog(task, saved))
    return catalogs, problems


def _catalog_of(catalogs: dict[str, TaskCatalog], task: Task, saved: SavedFilters | None, source: str) -> TaskCatalog:
    """The catalog of a task, added if missing. Raises BadInput if another task has the same name."""
    catalog = catalogs.setdefault(task.name, TaskCatalog(task, saved))
    if other := difference(catalog.task, task):
        raise BadInput(f"{source} has {other}; names of tasks must be unique in a server")
    return catalog


def short_names(paths: Iterable[Path], reserved: Collection[str] = ()) -> dict[str, Path]:
    """A unique name for each file or folder: its stem, preceded by as many parent folders as necessary.

    reserved: names that are already in use.
    """
    parts = {path: _name_parts(path) for path in {path.resolve(): path for path in paths}.values()}

    def name(path: Path) -> str:
        for count in range(1, len(parts[path])):
            tail = parts[path][-count:]
            matches = sum(other[-count:] == tail for other in parts.values())
            if matches == 1 and "-".join(tail) not in reserved:
                return "-".join(tail)
        return "-".join(parts[path])

    return {name(path): path for path in parts}


def result_folders(given: Mapping[str, Path], workspace: Path, file: str, reserved: str = "") -> dict[str, Path]:
    """Folders by name: those given to the server, and others in the workspace that contain ``file``."""
    paths = {folder.resolve() for folder in given.values()}
    others = [path.parent for path in sorted(workspace.glob(f"*/{file}")) if path.parent.resolve() not in paths]
    return {**given, **short_names(others, {*given, reserved})}


def served_names(filters: Sequence[str], data: Path | None) -> tuple[list[str], str]:
    """Names, as on the page, of filters (files, build functions or pretrained ones) and of the data.

    data: None is the sample set.
    """
    files = short_names(map(Path, filter(is_path, filters)), PRETRAINED)
    paths = {path.resolve(): name for name, path in files.items()}
    named = {text: external_name(text) for text in filters if is_code(text)}
    names = [paths[Path(text).resolve()] if is_path(text) else named.get(text, text) for text in filters]
    return names, SAMPLE if data is None else next(iter(short_names([data], {SAMPLE})))


def _name_parts(path: Path) -> tuple[str, ...]:
    valid = Path(os.fsencode(path.resolve()).decode(errors="replace"))  # names travel as JSON
    return (valid if valid.is_dir() else valid.with_suffix("")).parts[1:]


def _filter_json(name: str, checkpoint: Checkpoint) -> dict[str, Any]:
    record = dict(checkpoint.record)
    metrics = record.pop("metrics", {})
    return {
        "name": name,
        "kind": checkpoint.kind,
        "checkpoint_hash": checkpoint.hash,
        "training": record,
        "metrics": metrics,
    }


def _data_json(name: str, data: Dataset) -> dict[str, Any]:
    episode, step = initial_view(data)
    episodes = episode_list.nearby(data, episode)
    return {"name": name, "first": episode, "first_step": step, "count": len(data), "episodes": episodes}

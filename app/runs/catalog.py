"""What there is to show of each task: the filters and episodes that a server was given, and those that ship."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.faults.injection import ready
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Task
from beliefscope.filters.catalog import filters_of
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped

SAMPLE = "sample"
"""Name of the data set that ships with a task."""

FAVOURITE = "crossmodal-pf"
"""The first of the filters that ship."""


@dataclass
class Shelf:
    """The filters and data sets of one task by name, given ones first. What ships is opened when first looked at."""

    task: Task
    given_filters: dict[str, Checkpoint] = field(default_factory=dict)
    given_data: dict[str, Dataset] = field(default_factory=dict)

    @cached_property
    def filters(self) -> dict[str, Checkpoint]:
        found = dict(self.given_filters)
        for name in sorted(filters_of(self.task), key=lambda name: name != FAVOURITE):
            if name not in found:
                with suppress(BadInput):  # not every filter ships trained
                    found[name] = load_checkpoint(shipped(self.task.name, name))
        return found

    @cached_property
    def data(self) -> dict[str, Dataset]:
        found = dict(self.given_data)
        if SAMPLE not in found:
            with suppress(BadInput):  # nor does every task ship episodes
                found[SAMPLE] = open_dataset(sample_path(self.task.name), self.task)
        return found

    def place(self, name: str, checkpoint: Checkpoint, first: bool) -> None:
        """Puts a filter before all others, or behind those that were given."""
        others = {key: value for key, value in self.given_filters.items() if key != name}
        self.given_filters = {name: checkpoint, **others} if first else {**others, name: checkpoint}
        vars(self).pop("filters", None)

    def remove(self, name: str) -> None:
        """Takes a filter that was given away again; one that is not there is none."""
        self.given_filters.pop(name, None)
        vars(self).pop("filters", None)

    def filter(self, name: str) -> Checkpoint:
        """Raises BadInput for a name that is not here."""
        if name not in self.filters:
            raise one_of("filter", name, self.filters)
        return self.filters[name]

    def dataset(self, name: str) -> Dataset:
        """The data set of that name, or the first for an empty one. Raises BadInput for a name that is not here."""
        if name not in self.data and (name or not self.data):
            raise one_of("data", name, self.data)
        return self.data[name or next(iter(self.data))]

    def episode(self, data: str, index: int) -> Episode:
        """Raises BadInput for an index outside the data set."""
        episodes = self.dataset(data)
        if not 0 <= index < len(episodes):
            raise BadInput(f"episode {index} does not exist. Available: 0 to {len(episodes) - 1}.")
        return episodes[index]

    @property
    def missing(self) -> str | None:
        """What keeps the task from being shown, in one line; None where nothing does."""
        for what, there, option in (
            ("trained filter", self.filters, "--filter"),
            ("set of episodes", self.data, "--data"),
        ):
            if not there:
                return f"no {what} of task {self.task.name!r} is there to show; give one: {option} FILE"
        return None

    def describe(self) -> dict[str, Any]:
        """The task in the page's catalog."""
        task, (x, y) = self.task, self.task.map_components
        return {
            "name": task.name,
            "components": [{"name": c.name, "unit": c.unit} for c in task.components],
            "modalities": list(task.modalities),
            "dt": task.dt,
            "map": {"x": x, "y": y, "half_width": task.map_half_width},
            "fault_presets": [{"name": name, "faults": text} for name, text in ready(task).items()],
            "filters": [_filter(name, checkpoint) for name, checkpoint in self.filters.items()],
            "data": [
                {"name": name, "first": data.held_out()[0], "episodes": [asdict(summary) for summary in data.summaries]}
                for name, data in self.data.items()
            ],
        }

    def close(self) -> None:
        """Close the data sets that are open."""
        for data in (self.given_data | vars(self).get("data", {})).values():
            data.close()


def shelves(
    checkpoints: Mapping[str, Path | Checkpoint], data: Mapping[str, Path]
) -> tuple[dict[str, Shelf], list[str]]:
    """A shelf for each task, those that something was given for first; and a line for each thing that cannot be shown.

    Args:
        checkpoints: name as shown -> file, or a filter that is there already, as one from outside is.
        data: name as shown -> file, or folder of episodes.
    """
    made: dict[str, Shelf] = {}
    problems: list[str] = []
    for name, given in checkpoints.items():
        with _told(problems):
            checkpoint = given if isinstance(given, Checkpoint) else load_checkpoint(given)
            made.setdefault(checkpoint.task.name, Shelf(checkpoint.task)).given_filters[name] = checkpoint
    filtered = [shelf.task for shelf in made.values()]
    for name, path in data.items():
        with _told(problems):
            episodes = open_dataset(path)
            made.setdefault(episodes.task.name, Shelf(episodes.task)).given_data[name] = episodes
            # One file may hold episodes of several tasks: then it is for those too that filters were given for.
            for task in filtered:
                if task is not episodes.task:
                    other = open_dataset(path, task)
                    if other.task is task:
                        made[task.name].given_data[name] = other
                    else:
                        other.close()
    shown = {name for shelf in made.values() if not shelf.missing for name in shelf.given_data}
    for shelf in made.values():
        if shelf.missing and (shelf.given_filters or shelf.given_data.keys() - shown):
            problems.append(shelf.missing)
    return made | {name: Shelf(task) for name, task in TASKS.items() if name not in made}, problems


def short_names(paths: Iterable[Path], taken: Collection[str] = ()) -> dict[str, Path]:
    """A name for each file or folder: its own without its ending, and of the folders above it as many as tell it apart.

    Args:
        taken: names that stand for something else.
    """
    parts = {path: _parts(path) for path in {path.resolve(): path for path in paths}.values()}

    def name(path: Path) -> str:
        for count in range(1, len(parts[path])):
            ending = parts[path][-count:]
            alike = sum(other[-count:] == ending for other in parts.values())
            if alike == 1 and "-".join(ending) not in taken:
                return "-".join(ending)
        return "-".join(parts[path])

    return {name(path): path for path in parts}


def served_names(filters: Iterable[str | Path], data: Path | None) -> tuple[dict[str, str], str]:
    """The names that ``serve`` gives to these files: of filters by path, and of the data, the sample set if None."""
    ships = {name for task in TASKS.values() for name in filters_of(task)}
    named = {str(path): name for name, path in short_names([Path(one) for one in filters], ships).items()}
    return named, SAMPLE if data is None else next(iter(short_names([data], {SAMPLE})))


def _parts(path: Path) -> tuple[str, ...]:
    whole = Path(os.fsencode(path.resolve()).decode(errors="replace"))  # names are told in JSON
    return (whole if whole.is_dir() else whole.with_suffix("")).parts[1:]


def _filter(name: str, checkpoint: Checkpoint) -> dict[str, Any]:
    record = dict(checkpoint.record)
    metrics = record.pop("metrics", {})
    return {
        "name": name,
        "kind": checkpoint.kind,
        "checkpoint_hash": checkpoint.hash,
        "training": record,
        "metrics": metrics,
    }


@contextmanager
def _told(problems: list[str]) -> Iterator[None]:
    """What is wrong with one thing becomes a line; the others are shown."""
    try:
        yield
    except BadInput as error:
        problems.append(str(error))

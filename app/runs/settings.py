"""Settings of a server: which data and filters it offers, and its workspace."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from beliefscope.datasets.catalog import load_task, stored_task
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import task_to_json
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter, load_external
from beliefscope.filters.names import is_code

FOLDERS = ("data", "studies", "sweeps")
"""Fields with files and folders by name."""


@dataclass(frozen=True)
class Settings:
    """Settings of a server.

    Attributes:
        workspace: folder for recordings, traces and caches; created when needed.
        data: displayed name -> file or folder of episodes, listed before the sample sets.
        checkpoints: displayed name -> checkpoint file or external filter; listed before the pretrained filters, of
            which it replaces those with the same name.
        hosts: additional host names that the server answers to.
        views: maximum number of pages open at a time.
        tasks: user-defined tasks, as accepted by ``load_task``.
        studies, sweeps: displayed name -> folder of a study or of a sweep.
    """

    workspace: Path
    data: Mapping[str, Path] = field(default_factory=dict)
    checkpoints: Mapping[str, Path | Checkpoint] = field(default_factory=dict)
    hosts: tuple[str, ...] = ()
    particles: int = 300
    seed: int = 0
    views: int = 32
    tasks: tuple[str, ...] = ()
    studies: Mapping[str, Path] = field(default_factory=dict)
    sweeps: Mapping[str, Path] = field(default_factory=dict)

    @property
    def definitions(self) -> list[Task]:
        """The user-defined tasks. Runs their files once."""
        return [load_task(task) for task in self.tasks]

    def to_json(self) -> dict[str, Any]:
        """What other processes need, as JSON values, such as the sources of external filters."""
        return {
            "workspace": str(self.workspace),
            **{name: {key: str(path) for key, path in getattr(self, name).items()} for name in FOLDERS},
            "checkpoints": {
                name: {"source": source, "task": task_to_json(filter_.task)}
                if isinstance(filter_, ExternalFilter)
                else source
                for name, filter_ in self.checkpoints.items()
                if (source := origin(filter_)) is not None
            },
            "tasks": list(self.tasks),
            "particles": self.particles,
            "seed": self.seed,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Settings:
        """Inverse of ``to_json``. Loads the user-defined tasks and the external filters."""
        given = [load_task(task) for task in values["tasks"]]
        read: dict[str, Any] = {name: {key: Path(path) for key, path in values[name].items()} for name in FOLDERS}
        checkpoints = {
            name: Path(filter_)
            if isinstance(filter_, str)
            else load_external(filter_["source"], stored_task(filter_["task"], given))
            for name, filter_ in values["checkpoints"].items()
        }
        read |= {"workspace": Path(values["workspace"]), "checkpoints": checkpoints, "tasks": tuple(values["tasks"])}
        return cls(**{**values, **read})


def origin(filter_: Path | Checkpoint) -> str | None:
    """Checkpoint file or build function from which other processes can load a filter; None for one without either."""
    if isinstance(filter_, ExternalFilter):
        return filter_.source if is_code(filter_.source) else None
    path = filter_.path if isinstance(filter_, Checkpoint) else filter_
    return None if path is None else str(path)

"""Fine-tuned filters that are saved in a workspace, where all of its servers list them."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from beliefscope.app.workspace.finetune_runs import FineTuneRuns
from beliefscope.app.workspace.json_files import RecordCache, read_record
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint

FILE = "kept.json"


@dataclass(frozen=True)
class SavedFilter:
    """A saved filter. path: its checkpoint file. default: whether it is the default filter of its task."""

    task: str
    name: str
    path: str
    default: bool


class SavedFilters:
    """The saved filters of a workspace. Not thread-safe. tasks: user-defined ones, as for ``load_checkpoint``."""

    def __init__(self, workspace: Path, tasks: Iterable[Task] = ()) -> None:
        self._workspace = workspace
        self._path = workspace / FILE
        self._lists = RecordCache(partial(read_record, list[SavedFilter]))
        self._loaded = RecordCache(partial(load_checkpoint, given=tuple(tasks)))

    def all(self) -> list[SavedFilter]:
        """Those whose checkpoint exists; none if the list cannot be read."""
        with suppress(OSError, ValueError):
            return self._existing(self._lists.get(self._path) or [])
        return []

    def of_task(self, task: Task) -> Iterator[tuple[SavedFilter, Checkpoint]]:
        """Those of a task with their checkpoints, unless these are damaged or of another task with the same name."""
        for saved in self.all():
            checkpoint = self._loaded.get(Path(saved.path)) if saved.task == task.name else None
            if checkpoint is not None and not difference(task, checkpoint.task):
                yield saved, checkpoint

    def save(self, new: SavedFilter) -> None:
        """Add a filter. A default replaces the previous default of its task. Raises BadInput for an unreadable list."""
        others = [saved for saved in self._read() if (saved.task, saved.name) != (new.task, new.name)]
        if new.default:
            others = [replace(saved, default=saved.default and saved.task != new.task) for saved in others]
        self._lists.put(self._path, [new, *others])

    def remove(self, task: str, name: str) -> None:
        """Remove a filter; its checkpoint file is kept. Raises BadInput for an unreadable list."""
        others = [saved for saved in self._read() if (saved.task, saved.name) != (task, name)]
        self._lists.put(self._path, others)

    def _read(self) -> list[SavedFilter]:
        """Raises BadInput for a list that cannot be read, such as a later version's, so that it is not overwritten."""
        try:
            return self._existing(read_record(list[SavedFilter], self._path))
        except FileNotFoundError:
            return []
        except (OSError, ValueError, TypeError):
            raise BadInput(
                f"{str(self._path)!r} is damaged or was written by another version: move it away to start a new list"
            ) from None

    def _existing(self, filters: list[SavedFilter]) -> list[SavedFilter]:
        return [saved for saved in map(self._located, filters) if Path(saved.path).is_file()]

    def _located(self, saved: SavedFilter) -> SavedFilter:
        """With the path of the run in this workspace: the stored one may be relative, or of where it was before."""
        path = Path(saved.path)
        own = FineTuneRuns(self._workspace).folder(path.parent.name) / path.name
        return replace(saved, path=str(own)) if own.is_file() else saved

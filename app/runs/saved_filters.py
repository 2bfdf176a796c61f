"""Fine-tuned filters that are saved in a workspace and listed by its servers."""

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from pydantic import TypeAdapter

from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.finetune_runs import FineTuneRuns
from beliefscope.app.workspace.json_files import read_record, write_record
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint

FILE = "kept.json"


@dataclass(frozen=True)
class SavedFilter:
    """A saved filter. path: its checkpoint file. default: whether it is the default filter of its task."""

    task: str
    name: str
    path: str
    default: bool


RECORDS = TypeAdapter(list[SavedFilter])


def read_saved_filters(workspace: Path) -> list[SavedFilter]:
    """The saved filters whose checkpoint exists; none if the list cannot be read."""
    with suppress(BadInput):
        return _read(workspace)
    return []


def with_saved_filters(settings: Settings) -> Settings:
    """The settings, extended by the saved filters of the workspace."""
    filters = read_saved_filters(settings.workspace)
    first = {saved.name: Path(saved.path) for saved in filters if saved.default}
    last = {saved.name: Path(saved.path) for saved in filters if not saved.default}
    checkpoints, secondary = {**first, **settings.checkpoints, **last}, last.keys() - settings.checkpoints.keys()
    names = frozenset(checkpoints.keys() - settings.checkpoints.keys())
    return replace(settings, checkpoints=checkpoints, secondary=frozenset(secondary), saved=names)


def refresh_saved_filters(store: TraceStore) -> None:
    """Add filters that another server of the workspace has saved, and remove filters that left its list.

    Filters whose checkpoint was deleted are removed as well. A list that cannot be read changes nothing.
    """
    try:
        listed = _read(store.settings.workspace)
    except BadInput:
        return
    names = {(saved.task, saved.name) for saved in listed}
    for task in store.tasks():
        for name in store.settings.saved & store.filters(task).keys():
            if (task, name) not in names:
                store.remove_filter(task, name)
    for saved in listed:
        with suppress(BadInput):  # damaged, or of a task that this server does not have
            if saved.name not in store.filters(saved.task):
                _add(store, saved, load_checkpoint(Path(saved.path)))


def save_filter(store: TraceStore, new: SavedFilter) -> None:
    """Add a filter to the catalog and to the list. A default replaces the previous default of its task.

    Raises BadInput if the checkpoint or the list cannot be read.
    """
    others = [saved for saved in _read(store.settings.workspace) if (saved.task, saved.name) != (new.task, new.name)]
    if new.default:
        others = [replace(saved, default=saved.default and saved.task != new.task) for saved in others]
    checkpoint = load_checkpoint(Path(new.path))
    write_record([new, *others], store.settings.workspace / FILE)  # first: a page that is loading removes other filters
    _add(store, new, checkpoint)


def remove_filter(store: TraceStore, task: str, name: str) -> None:
    """Remove a filter from the catalog and the list. Its checkpoint file is kept."""
    workspace = store.settings.workspace
    others = [saved for saved in _read(workspace) if (saved.task, saved.name) != (task, name)]
    write_record(others, workspace / FILE)  # first: a page that is loading adds the filters of the list
    store.remove_filter(task, name)


def _add(store: TraceStore, saved: SavedFilter, checkpoint: Checkpoint) -> None:
    store.add_filter(saved.task, saved.name, checkpoint, first=saved.default, saved=True)


def _read(workspace: Path) -> list[SavedFilter]:
    """Raises BadInput for a list that cannot be read, such as a later version's, so that it is not overwritten."""
    path = workspace / FILE
    try:
        saved = [_located(saved, workspace) for saved in read_record(RECORDS, path)]
        return [filter_ for filter_ in saved if Path(filter_.path).is_file()]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError):
        raise BadInput(
            f"{str(path)!r} is damaged or was written by another version: move it away to start a new list"
        ) from None


def _located(saved: SavedFilter, workspace: Path) -> SavedFilter:
    """With the path of the run in this workspace: the stored one may be relative, or of a place it was moved from."""
    path = Path(saved.path)
    own = FineTuneRuns(workspace).folder(path.parent.name) / path.name
    return replace(saved, path=str(own)) if own.is_file() else saved

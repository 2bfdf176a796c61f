"""Fine-tuned filters that a workspace keeps: they stand on its server's shelf beside what was given, or before it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from pydantic import TypeAdapter

from beliefscope.app.runs.trace_store import Library, Settings
from beliefscope.app.workspace.json_files import read_record
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.filters.checkpoint import load_checkpoint

FILE = "kept.json"


@dataclass(frozen=True)
class Child:
    """One that is kept. path: of its checkpoint. default: whether it comes before all others of its task."""

    task: str
    name: str
    path: str
    default: bool


RECORDS = TypeAdapter(list[Child])


def read(workspace: Path) -> list[Child]:
    """Those whose files are still there; of a list that cannot be read, none."""
    with suppress(BadInput):
        return _read(workspace)
    return []


def _read(workspace: Path) -> list[Child]:
    """Raises BadInput for a list that cannot be read, such as a later version's, which is not to be overwritten."""
    path = workspace / FILE
    try:
        return [one for one in read_record(RECORDS, path) if Path(one.path).is_file()]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError):
        raise BadInput(f"{str(path)!r} is damaged or another version's: move it away to begin a new one") from None


def with_children(settings: Settings) -> Settings:
    """The settings of a server that shows them too."""
    kept = read(settings.workspace)
    first = {one.name: Path(one.path) for one in kept if one.default}
    last = {one.name: Path(one.path) for one in kept if not one.default}
    return replace(settings, checkpoints={**first, **settings.checkpoints, **last}) if kept else settings


def keep(library: Library, child: Child) -> None:
    """Puts it on the shelf; as the default it takes the place of the one before. Raises BadInput for no checkpoint."""
    others = [one for one in _read(library.settings.workspace) if (one.task, one.name) != (child.task, child.name)]
    if child.default:
        others = [replace(one, default=one.default and one.task != child.task) for one in others]
    library.adopt(child.task, child.name, load_checkpoint(Path(child.path)), Path(child.path), child.default)
    _write(library.settings.workspace, [child, *others])


def drop(library: Library, task: str, name: str) -> None:
    """Takes it off the shelf; its file stays. What was there before it is what comes first again."""
    workspace = library.settings.workspace
    others = [one for one in _read(workspace) if (one.task, one.name) != (task, name)]
    library.dismiss(task, name)
    _write(workspace, others)


def _write(workspace: Path, children: Sequence[Child]) -> None:
    workspace.mkdir(parents=True, exist_ok=True)
    write_atomically(workspace / FILE, json.dumps([asdict(one) for one in children], indent=2).encode())

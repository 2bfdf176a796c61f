"""Fine-tuning runs of a workspace: one folder each, with settings, progress, checkpoint and result."""

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasChoices, Field

from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.workspace.json_files import content, read_record, write_record
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.legacy_names import rename_keys

OLD_FILES = {"finetuned.safetensors": "child.safetensors", "result.json": "found.json"}
OLD_KEYS = {"child": "finetuned", "change": "comparison", "moments": "events", "looks": "validations"}
"""File names and keys of earlier versions, which are still read."""


@dataclass(frozen=True)
class FineTuneRun:
    """A run. run: its id. submitted: s since 1970."""

    run: str
    task: str
    filter: str
    data: str
    settings: dict[str, Any]
    submitted: Annotated[float, Field(validation_alias=AliasChoices("submitted", "asked"))]


class FineTuneRuns:
    """The fine-tuning runs of a workspace."""

    def __init__(self, workspace: Path) -> None:
        self._folder = workspace / "finetune"

    def folder(self, run: str) -> Path:
        """Folder of a run."""
        return self._folder / run

    def add(self, run: str, task: str, filter_: str, data: str, settings: FineTune) -> FineTuneRun:
        """Record a run, which may exist."""
        record = FineTuneRun(run, task, filter_, data, settings.to_json(), time.time())
        write_record(record, self.folder(run) / "run.json")
        return record

    def list_runs(self) -> list[FineTuneRun]:
        """All runs, newest first; invalid records are skipped."""
        runs = []
        for path in self._folder.glob("*/run.json"):
            with suppress(OSError, ValueError):
                run = read_record(FineTuneRun, path)
                if run.run == path.parent.name:
                    settings = FineTune.from_json(run.settings).to_json()  # renames settings of earlier versions
                    runs.append(FineTuneRun(**vars(run) | {"settings": settings}))
        return sorted(runs, key=lambda run: -run.submitted)

    def get(self, name: str) -> FineTuneRun:
        """Raises NotFound."""
        for run in self.list_runs():
            if run.run == name:
                return run
        raise NotFound(f"Run {name!r} does not exist.")

    def checkpoints(self) -> list[Path]:
        """The checkpoints of all runs."""
        names = ("finetuned.safetensors", OLD_FILES["finetuned.safetensors"])
        return sorted(path for name in names for path in self._folder.glob(f"*/{name}"))

    def is_own(self, checkpoint: Path) -> bool:
        """Whether the checkpoint is the result of a run."""
        return checkpoint.parent.parent == self._folder

    def file(self, run: str, name: str) -> Path:
        """Path of a file of a run, under its old name if that exists."""
        path = self.folder(run) / name
        old = self.folder(run) / OLD_FILES.get(name, name)
        return old if old.is_file() and not path.is_file() else path

    def read(self, run: str, name: str) -> dict[str, Any] | None:
        """A JSON file of a run (``progress.json`` or ``result.json``); None if it does not exist."""
        with suppress(OSError, ValueError):
            document = read_json(content(self.file(run, name)))
            return rename_keys(document, OLD_KEYS) if isinstance(document, dict) else None
        return None

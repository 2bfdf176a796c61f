"""Run filters on request: with a file cache of traces, and interventions as replays of the original run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beliefscope.app.runs.selection import Selection
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace
from beliefscope.inspect.traces.replay import Replay

Progress = Callable[[float], None]
"""Called with the completed fraction, 0..1. An exception that it raises ends the run."""


@dataclass(frozen=True)
class RunRequest:
    """A filter run in terms of files, so that another process can carry it out.

    Attributes:
        selection: the run.
        checkpoint: checkpoint file, or the source of an external filter.
        external_task: task of an external filter; empty for a checkpoint file.
        data: file or folder of episodes, or the file of a live run.
        original: trace file of the run without intervention.
        output: trace file of the run.
        seed, particles: settings of the filter.
        user_tasks: user-defined tasks to register first.
    """

    selection: Selection
    checkpoint: str
    external_task: str
    data: str
    original: str
    output: str
    seed: int
    particles: int
    user_tasks: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The request as JSON values."""
        return {**vars(self), "selection": self.selection.to_json()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> RunRequest:
        """Inverse of ``to_json``."""
        return cls(**{**values, "selection": Selection.from_json(values["selection"])})


class FilterRunner:
    """Runs filters, one at a time. Keeps the replay of the run that was edited last."""

    def __init__(self) -> None:
        self._replay: tuple[str, Replay] | None = None

    def run(self, request: RunRequest, checkpoint: Checkpoint, episode: Episode, progress: Progress) -> Trace:
        """The trace of the requested run. Only traces without intervention are read from and written to a file.

        Raises BadInput if the request does not fit the filter.
        """
        edit = request.selection.edit
        if edit is None:
            return _run_or_load(request, checkpoint, episode, progress)
        if self._replay is None or self._replay[0] != request.original:
            original = _run_or_load(request, checkpoint, episode, progress)
            self._replay = request.original, Replay(checkpoint, original, progress)
        return self._replay[1].edited(edit)


def _run_or_load(request: RunRequest, checkpoint: Checkpoint, episode: Episode, progress: Progress) -> Trace:
    """The trace of the run without intervention: from its file if that is readable, else computed and saved."""
    path = Path(request.original)
    if path.is_file():
        with suppress(BadInput):
            return load_trace(path)
    result = trace(
        checkpoint,
        episode,
        episode_index=request.selection.episode,
        seed=request.seed,
        particles=request.particles,
        faults=request.selection.faults,
        progress=progress,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    save_trace(result, path)
    return result

"""Runs of a filter whose traces are stored in files, and interventions as replays of the original run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.standalone import standalone
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace
from beliefscope.inspect.traces.external_replay import ExternalReplay, open_replay
from beliefscope.inspect.traces.replay import Intervention, Replay
from beliefscope.inspect.traces.restarts import trace_with_restarts

Progress = Callable[[float], None]
"""Called with the completed fraction, 0..1. An exception that it raises ends the run."""


class StoredRuns:
    """Runs filters, one at a time. Keeps the replay of the run of the last intervention."""

    def __init__(self) -> None:
        self._replay: tuple[Path, Replay | ExternalReplay] | None = None

    def run(
        self,
        checkpoint: Checkpoint,
        episode: Episode,
        *,
        path: Path,
        intervention: Intervention | None,
        only: str,
        progress: Progress,
        **settings: Any,
    ) -> Trace:
        """The trace of a run. Raises BadInput if the settings do not fit the filter.

        Args:
            path: trace file of the run without intervention and with all modalities: read if possible, else written.
            intervention, only: the intervention, or the only modality to use, or neither. Traces with one of them are
                not stored.
            settings: as for ``trace``.
        """
        if only:
            return standalone(checkpoint, _run_or_load(path, checkpoint, episode, progress, settings), only, progress)
        if intervention is None:
            return _run_or_load(path, checkpoint, episode, progress, settings)
        if self._replay is None or self._replay[0] != path:
            original = _run_or_load(path, checkpoint, episode, progress, settings)
            self._replay = path, open_replay(checkpoint, original, progress)
        return self._replay[1].with_intervention(intervention)


def _run_or_load(
    path: Path, checkpoint: Checkpoint, episode: Episode, progress: Progress, settings: dict[str, Any]
) -> Trace:
    """The stored trace, or that of a run; an external filter that fails at a step is restarted at the true state."""
    if path.is_file():
        with suppress(BadInput):
            return load_trace(path)
    if isinstance(checkpoint, ExternalFilter):
        own = {name: value for name, value in settings.items() if name != "particles"}
        result = trace_with_restarts(checkpoint, episode, progress=progress, **own)
    else:
        result = trace(checkpoint, episode, progress=progress, **settings)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_trace(result, path)
    return result

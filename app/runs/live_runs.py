"""Live runs of a workspace: files to which a running filter appends its steps (``inspect.traces.live_file``).

A run is the only episode of the data set ``live:NAME``. The filter and its viewers communicate through the file alone.
"""

import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from beliefscope.app.protocol.trace_format import header
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.traced_run import DEFAULT_MAP, TracedRun
from beliefscope.app.workspace.json_files import is_text
from beliefscope.app.workspace.paths import file_within
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import NO_FAULTS
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.maps.availability import missing_quantities, no_maps
from beliefscope.inspect.maps.likelihood_map import MapOptions
from beliefscope.inspect.maps.map_engine import LikelihoodMap, MapEngine
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.live_file import SUFFIX
from beliefscope.inspect.traces.live_run import LiveRun

LIVE_PREFIX = "live:"
LISTED_RUNS = 100  # most recent ones; each keeps its file open
RUNS_IN_MEMORY = 4  # most recent ones


class GrowingRun(TracedRun):
    """A live run that has not ended, up to a certain step. Steps are read from the file on demand."""

    growing = True

    def __init__(self, run: LiveRun, checkpoint: Checkpoint) -> None:
        super().__init__(run.key, checkpoint)
        self._run, self._part, self._steps = run, run.reader.part, run.reader.steps
        self._last = self._part(max(0, self._steps - 1), self._steps)
        self.scene_key = f"{run.name} {run.inode}"

    @cached_property
    def trace(self) -> Trace:
        """All steps in one trace."""
        return self._part(0, self._steps)

    def ready(self, timeout: float) -> bool:
        """Whether there is a step."""
        return self._steps > 0

    def __len__(self) -> int:
        return self._steps

    def at(self, step: int) -> tuple[Trace, int]:
        return self._part(step, step + 1), 0

    @cached_property
    def no_maps(self) -> str | None:
        return no_maps(self.checkpoint, self._last)

    def map(self, step: int, size: int, options: MapOptions = DEFAULT_MAP) -> LikelihoodMap:
        """Compute the map from this step alone, without encoding the images of all earlier steps."""
        engine = MapEngine(self.checkpoint, self.at(step)[0])
        return replace(engine.available_map(0, size, options), step=step)

    @property
    def header(self) -> dict[str, Any]:
        """Description of the run for the page. Each block of steps describes its own columns."""
        missing = missing_quantities(self.checkpoint, self._last)
        description = header(self._last, [], self._run.task, self.no_maps, missing)
        # A growing array of numbers has no range yet; the page receives the images of one sensor.
        sensors = [sensor for sensor in description["sensors"] if sensor.low is None][:1]
        return description | {"sensors": sensors, "steps": self._steps, "live": describe(self._run)}


class LiveRuns:
    """The live files of a folder. Methods may be called from any thread."""

    def __init__(self, folder: Path, tasks: Sequence[Task] = ()) -> None:
        """tasks: user-defined tasks, as for ``stored_task``."""
        self.folder, self._tasks = folder, tasks
        self._runs: dict[str, LiveRun] = {}
        self._traced: dict[str, TracedRun] = {}  # the newest state of each requested run, most recent last
        self._lock = threading.Lock()

    def __getitem__(self, name: str) -> LiveRun:
        """The run in its current state. Raises BadInput if it does not exist or is not a live run."""
        path = self.folder / f"{name}{SUFFIX}"
        if not name or "/" in name or file_within(self.folder, path.name) is None:
            raise BadInput(f"live run {name!r} does not exist in {str(self.folder)!r}")
        with self._lock:
            run = self._runs.get(name)
            if run is None or run.inode != path.stat().st_ino:
                if run is not None:
                    run.close()
                    del self._runs[name]
                run = self._runs[name] = LiveRun(path, self._tasks)
        run.poll()
        return run

    def newest(self) -> list[str]:
        """Names of the runs, most recent first. Closes runs whose files were deleted."""
        times: dict[str, float] = {}
        for path in self.folder.glob(f"*{SUFFIX}") if self.folder.is_dir() else ():
            with suppress(OSError):
                if is_text(path.name):
                    times[path.name.removesuffix(SUFFIX)] = path.stat().st_mtime
        with self._lock:
            for name in self._runs.keys() - times.keys():
                self._runs.pop(name).close()
        return sorted(times, key=lambda name: -times[name])[:LISTED_RUNS]

    def traced_run(self, run: LiveRun, selection: Selection, name: str, checkpoint: Checkpoint) -> TracedRun | None:
        """The live run, or None if the selection applies another filter, faults or an intervention to its episode.

        name, checkpoint: of the run's filter (``resolve_filter``). Raises BadInput if the run belongs to another task
        or episode, or ended without a step.
        """
        if (selection.task, selection.episode) != (run.task.name, run.template.episode_index):
            raise BadInput(
                f"live run {run.name!r} is of task {run.task.name!r}, episode {run.template.episode_index}, "
                f"not of {selection.task!r}, episode {selection.episode}"
            )
        if (selection.filter, selection.faults, selection.intervention, selection.only) != (name, NO_FAULTS, None, ""):
            return None
        running = run.state == "running"
        if not running and not run.reader.steps:
            raise BadInput(run.message or f"live run {run.name!r} ended before its first step")
        with self._lock:
            traced = self._traced.pop(run.name, None)
            state = (run.key, running, checkpoint.healthy_profile)
            if traced is None or (traced.key, traced.growing, traced.checkpoint.healthy_profile) != state:
                traced = GrowingRun(run, checkpoint) if running else TracedRun(run.key, checkpoint)
                if not running:
                    traced.future.set_result(run.reader.part(0))
            self._traced[run.name] = traced
            while len(self._traced) > RUNS_IN_MEMORY:
                del self._traced[next(iter(self._traced))]
            return traced

    def ended_run(self, data: str) -> LiveRun:
        """The run of a data set's name. Raises BadInput while it is running."""
        run = self[data.removeprefix(LIVE_PREFIX)]
        if run.state == "running":
            raise BadInput(f"live run {run.name!r} is still running; this needs all of its steps")
        return run

    def of_same_filter(self, selection: Selection) -> list[Selection]:
        """The ended runs with the task and filter of a selected live run, in the order of their names."""
        run = self.ended_run(selection.data)
        selections = []
        for name in sorted(self.newest()):
            with suppress(BadInput):
                other = self[name]
                if other.state != "running" and other.reader.steps and _filter(other) == _filter(run):
                    episode = other.template.episode_index
                    selections.append(replace(selection, data=f"{LIVE_PREFIX}{name}", episode=episode))
        return selections

    def episode(self, data: str) -> Episode:
        """The input of a run's filter. Raises BadInput while the run is running, and if its first state is unknown."""
        run = self.ended_run(data)
        episode = run.reader.part(0).episode
        if not len(episode) or np.isnan(episode.states[0]).any():
            raise BadInput(f"live run {run.name!r} has no true state from which a filter could start")
        return episode

    def close(self) -> None:
        """Close the files."""
        with self._lock:
            for run in self._runs.values():
                run.close()
            self._runs.clear()


def _filter(run: LiveRun) -> tuple[str, str, str]:
    """Task, name and hash of a run's filter."""
    return run.task.name, run.template.filter, run.template.checkpoint_hash


def describe(run: LiveRun) -> dict[str, Any]:
    """A live run in the page's list."""
    return {
        "name": run.name,
        "data": f"{LIVE_PREFIX}{run.name}",
        "task": run.task.name,
        "episode": run.template.episode_index,
        "faults": str(run.template.faults),
        "steps": run.reader.steps,
        "expected": run.reader.expected,
        "started": run.reader.started,
        "state": run.state,
        "message": run.message,
    }


def resolve_filter(run: LiveRun, filters: Mapping[str, Checkpoint]) -> tuple[str, Checkpoint]:
    """Displayed name and checkpoint of a run's filter, found among its task's filters by its hash."""
    hash_ = run.template.checkpoint_hash
    name = display_name(run.template.filter, hash_, filters)
    checkpoint = filters.get(name)
    if checkpoint is not None and checkpoint.hash == hash_:
        return name, checkpoint
    return name, UnavailableFilter(run.template.filter, hash_, run.task)


def display_name(name: str, hash_: str, filters: Mapping[str, Checkpoint], suffix: str = "live") -> str:
    """The displayed name of a run's filter: that of the same checkpoint in ``filters``, else its own name.

    suffix: follows its own name if another filter has the same.
    Slashes become hyphens, as in ``odometry-filtered``, because the name is one part of the path of an address.
    """
    matches = [key for key, checkpoint in filters.items() if hash_ and checkpoint.hash == hash_]
    if matches:
        return name if name in matches else matches[0]
    name = name.strip("/").replace("/", "-")
    return f"{name} ({suffix})" if name in filters else name

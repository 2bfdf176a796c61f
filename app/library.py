"""Data sets, checkpoints and traces of one server, each loaded or computed once, when first asked for."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from beliefscope.app.wire import MAP_SIZES, columns
from beliefscope.datasets.catalog import TASKS, find_task
from beliefscope.datasets.corrupt import WHOLE, Recipe, ready
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Task
from beliefscope.filters.catalog import filters_of
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.inspect.likelihood import LikelihoodMap, MapEngine
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace

TRACES_IN_MEMORY = 8
DEFAULT_FILTER = "crossmodal-pf"
FINE = max(MAP_SIZES)


@dataclass(frozen=True)
class Settings:
    """What a server shows, and where it keeps things.

    Attributes:
        workspace: folder for recordings, traces and caches; made when needed.
        data: task -> HDF5 file; the shipped sample set where a task is not named.
        checkpoints: filter's name as shown -> file, beside (or in place of) the shipped ones.
        hosts: names the server answers to beside the loopback's.
        particles: of particle filters. seed: of the filters' randomness.
    """

    workspace: Path
    data: Mapping[str, Path] = field(default_factory=dict)
    checkpoints: Mapping[str, Path] = field(default_factory=dict)
    hosts: tuple[str, ...] = ()
    particles: int = 300
    seed: int = 0


@dataclass(frozen=True)
class Selection:
    """What is being looked at: names of a task and a filter, an episode's index, how its sensors are broken."""

    task: str
    filter: str
    episode: int
    recipe: Recipe = WHOLE


class Traced:
    """A trace that is being computed, or is there; and what is derived from it.

    Attributes:
        key: hash of everything the trace depends on: checkpoint, episode, seed, particles, recipe.
        done: the trace, or the error that computing it ended in. progress: 0..1.
    """

    def __init__(self, key: str, checkpoint: Checkpoint) -> None:
        self.key = key
        self.checkpoint = checkpoint
        self.done: Future[Trace] = Future()
        self.done.set_running_or_notify_cancel()  # so that who stops waiting for it cannot cancel it
        self.progress = 0.0
        self._maps = threading.Lock()

    @property
    def trace(self) -> Trace:
        """Waits for it. Raises what computing it raised."""
        return self.done.result()

    @cached_property
    def columns(self) -> tuple[list[dict[str, Any]], bytes]:
        """The trace's numbers as the page wants them: descriptions and one buffer."""
        return columns(self.trace)

    def map(self, step: int, angle: float | None, size: int) -> LikelihoodMap:
        """One likelihood map; one at a time a trace, because its engine keeps caches."""
        with self._maps:
            return self._engine.map(step, angle=angle, size=size)

    def maps(self, steps: Iterable[int]) -> Iterator[LikelihoodMap]:
        """The fine maps at several steps; other askers get theirs in between."""
        return (self.map(step, None, FINE) for step in steps)

    @cached_property
    def _engine(self) -> MapEngine:
        return MapEngine(self.checkpoint, self.trace)


class Library:
    """Everything a server can show. Methods may be called from any thread; they block, so not from the event loop."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._lock = threading.RLock()
        self._datasets: dict[str, Dataset] = {}
        self._checkpoints: dict[tuple[str, str], Checkpoint] = {}
        self._keys: dict[Selection, str] = {}
        self._traced: OrderedDict[str, Traced] = OrderedDict()
        self._tracing = ThreadPoolExecutor(max_workers=1, thread_name_prefix="tracing")
        self._closing = False

    def dataset(self, task: str) -> Dataset:
        """The task's data set. Raises BadInput for an unknown task or an unreadable file."""
        with self._lock:
            if task not in self._datasets:
                known = find_task(task)
                data = open_dataset(self.settings.data.get(known.name) or sample_path(known.name), known)
                if data.task.name != known.name:
                    raise BadInput(f"The data given for task {known.name!r} are of task {data.task.name!r}.")
                self._datasets[task] = data
            return self._datasets[task]

    def episode(self, task: str, index: int) -> Episode:
        """Raises BadInput for an index outside the data set."""
        with self._lock:
            data = self.dataset(task)
            if not 0 <= index < len(data):
                raise BadInput(f"episode {index} does not exist. Available: 0 to {len(data) - 1}.")
            return data[index]

    def checkpoint(self, task: str, name: str) -> Checkpoint:
        """The filter of that name. Raises BadInput for an unknown name or an unreadable file."""
        with self._lock:
            if (task, name) not in self._checkpoints:
                known = filters_of(find_task(task))
                given = self.settings.checkpoints
                if name not in given and name not in known:
                    raise one_of("filter", name, [*given, *(f for f in known if f not in given)])
                checkpoint = load_checkpoint(given[name]) if name in given else None
                if checkpoint is not None and checkpoint.task.name != task:
                    if name not in known:
                        raise BadInput(f"filter {name!r} is for task {checkpoint.task.name!r}, not for {task!r}.")
                    checkpoint = None  # the one that ships for this task
                self._checkpoints[task, name] = checkpoint or load_checkpoint(shipped(task, name))
            return self._checkpoints[task, name]

    def catalog(self) -> dict[str, Any]:
        """``tasks`` that can be shown, and ``problems``: one line for each thing given that cannot be."""
        tasks, problems = [], []
        of_task: dict[str, list[str]] = {}
        for filter_name, path in self.settings.checkpoints.items():
            try:
                of_task.setdefault(load_checkpoint(path).task.name, []).append(filter_name)
            except BadInput as error:
                problems.append(str(error))
        # What was given comes first.
        for name in sorted(TASKS, key=lambda name: name not in self.settings.data):
            try:
                data = self.dataset(name)
            except BadInput as error:
                if name in self.settings.data:
                    problems.append(str(error))
                continue
            filters = []
            for filter_name in dict.fromkeys([*of_task.get(name, []), *filters_of(data.task)]):
                with suppress(BadInput):  # most do not ship; one that was given and is bad is a problem already
                    filters.append(_described(filter_name, self.checkpoint(name, filter_name)))
            tasks.append(_task(data.task, filters, data))
        return {"tasks": tasks, "problems": problems}

    def default(self) -> Selection:
        """What a page shows first: the first task, the crossmodal PF if there is one, the first episode for tests.

        Raises BadInput where there is no filter to show.
        """
        catalog = self.catalog()
        for task in catalog["tasks"]:
            names = [f["name"] for f in task["filters"]]
            if names:
                name = DEFAULT_FILTER if DEFAULT_FILTER in names else names[0]
                return Selection(task["name"], name, self.dataset(task["name"]).held_out()[0])
        raise BadInput("; ".join(catalog["problems"]) or "no trained filter is there to show; train one first.")

    def traced(self, selection: Selection) -> Traced:
        """The selection's trace, computed from now on if it is not there. Raises BadInput for what does not exist."""
        with self._lock:
            known = self._traced.get(self._keys.get(selection, ""))
            if known is None or (known.done.done() and known.done.exception() is not None):
                checkpoint = self.checkpoint(selection.task, selection.filter)
                episode = self.episode(selection.task, selection.episode)
                selection.recipe.check(checkpoint.task)
                parts = (
                    checkpoint.hash,
                    episode.digest(),
                    self.settings.seed,
                    self.settings.particles,
                    str(selection.recipe),
                )
                key = hashlib.sha256(repr(parts).encode()).hexdigest()
                self._keys[selection] = key
                known = self._traced[key] = Traced(key, checkpoint)
                self._tracing.submit(self._compute, known, selection, episode)
            self._traced.move_to_end(known.key)
            while len(self._traced) > TRACES_IN_MEMORY:
                self._traced.popitem(last=False)
            return known

    def _compute(self, traced: Traced, selection: Selection, episode: Episode) -> None:
        def progress(fraction: float) -> None:
            if self._closing:
                raise CancelledError
            traced.progress = fraction

        name = f"{selection.task}-{selection.filter}-episode{selection.episode}-{traced.key[:16]}.trace"
        path = self.settings.workspace / "traces" / name
        try:
            # A trace file that cannot be read is only a cache: it is computed and written again.
            with suppress(BadInput):
                traced.done.set_result(load_trace(path))
                return
            result = trace(
                traced.checkpoint,
                episode,
                episode_index=selection.episode,
                seed=self.settings.seed,
                particles=self.settings.particles,
                recipe=selection.recipe,
                progress=progress,
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            save_trace(result, path)
            traced.done.set_result(result)
        except BaseException as error:
            traced.done.set_exception(error)

    def close(self) -> None:
        """Give up what is being computed and close the data sets."""
        self._closing = True
        self._tracing.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            for data in self._datasets.values():
                data.close()
            self._datasets.clear()


def _described(name: str, checkpoint: Checkpoint) -> dict[str, Any]:
    record = dict(checkpoint.record)
    metrics = record.pop("metrics", {})
    return {
        "name": name,
        "kind": checkpoint.kind,
        "checkpoint_hash": checkpoint.hash,
        "training": record,
        "metrics": metrics,
    }


def _task(task: Task, filters: list[dict[str, Any]], data: Dataset) -> dict[str, Any]:
    x, y = task.map_components
    return {
        "name": task.name,
        "components": [{"name": c.name, "unit": c.unit} for c in task.components],
        "modalities": list(task.modalities),
        "dt": task.dt,
        "map": {"x": x, "y": y, "half_width": task.map_half_width},
        "data_hash": data.hash,
        "recipes": [{"name": name, "recipe": text} for name, text in ready(task).items()],
        "filters": filters,
        "episodes": [
            {
                "index": e.index,
                "steps": e.steps,
                "policy": e.policy,
                "split": e.split,
                "seed": e.seed,
                "contact_fraction": e.contact_fraction,
            }
            for e in data.summaries
        ],
    }

"""Traces of one server, each computed once, when first asked for; and the catalog of what there is to trace."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

from beliefscope.app.jobs.queue import QueueFull
from beliefscope.app.runs.catalog import Shelf, shelves
from beliefscope.app.runs.live_runs import PREFIX, LiveRuns
from beliefscope.app.runs.selection import Selection, Traced
from beliefscope.app.runs.trace_worker import Tracer
from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import Foreign, load_foreign
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace
from beliefscope.inspect.traces.replay import Edit, Replay

__all__ = ["Library", "Selection", "Settings", "Traced"]

TRACES_IN_MEMORY = 8
"""The newest ones that are kept though nobody shows them."""

BYTES_IN_MEMORY = 256 << 20
"""What they may take; one is kept however large it is."""

RUNS_WAITING = 64
"""Runs of filters that are asked for and not begun; one that somebody asks for beyond that is not taken."""

KEYS_KEPT = 4096
"""Selections whose key is remembered: a few hundred bytes each."""


@dataclass(frozen=True)
class Settings:
    """What a server shows, and where it keeps things.

    Attributes:
        workspace: folder for recordings, traces and caches; made when needed.
        data: name as shown -> file or folder of episodes, before the sample sets that ship.
        checkpoints: filter's name as shown -> file, or a filter from outside; before (or in place of) those that ship.
        hosts: names the server answers to beside the loopback's.
        particles: of particle filters. seed: of the filters' randomness. views: most pages that are open at a time.
        tasks: the user's own, as ``load_task`` knows them. studies: name as shown -> folder of a study.
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

    def to_json(self) -> dict[str, Any]:
        """As JSON, for another process. A filter from outside is named by what makes it."""
        checkpoints = {
            name: {"source": given.source, "task": given.task.name} if isinstance(given, Foreign) else str(given)
            for name, given in self.checkpoints.items()
        }
        data = {name: str(path) for name, path in self.data.items()}
        shown = {"workspace": str(self.workspace), "data": data, "checkpoints": checkpoints, "tasks": list(self.tasks)}
        return shown | {"particles": self.particles, "seed": self.seed}

    @classmethod
    def of_json(cls, shown: Mapping[str, Any]) -> Settings:
        """What ``to_json`` gave. The user's own tasks are in ``TASKS`` then; filters from outside are made again."""
        for name in shown["tasks"]:
            load_task(name)
        return cls(
            Path(shown["workspace"]),
            {name: Path(path) for name, path in shown["data"].items()},
            {
                name: Path(given) if isinstance(given, str) else load_foreign(given["source"], given["task"])
                for name, given in shown["checkpoints"].items()
            },
            particles=shown["particles"],
            seed=shown["seed"],
            tasks=tuple(shown["tasks"]),
        )


class Library:
    """Everything a server can show. Methods may be called from any thread; they block, so not from the event loop."""

    def __init__(self, settings: Settings, tracer: Tracer | None = None) -> None:
        """Tracer: runs the filters in another process; without it a thread does."""
        self.settings = settings
        self.live = LiveRuns(settings.workspace / "live")
        self._tracer = tracer
        self._lock = threading.RLock()
        self._keys: OrderedDict[Selection, str] = OrderedDict()
        self._hashing = threading.Lock()
        self._hashes: dict[tuple[str, str], str] = {}
        self._traced: OrderedDict[str, Traced] = OrderedDict()
        self._living: WeakValueDictionary[str, Traced] = WeakValueDictionary()  # those too that only a view still shows
        self._tracing = ThreadPoolExecutor(max_workers=1, thread_name_prefix="tracing")
        self._replay: tuple[str, Replay] | None = None  # of the run that was edited last; for the tracing thread alone
        self._waiting = 0  # runs that were handed to that thread and are not begun
        self._closing = False

    @cached_property
    def _stock(self) -> tuple[dict[str, Shelf], list[str]]:
        return shelves(self.settings.checkpoints, self.settings.data)

    def problems(self) -> list[str]:
        """One line for each thing given that cannot be shown."""
        with self._lock:
            return self._stock[1]

    def catalog(self) -> dict[str, Any]:
        """``tasks`` that can be shown, and the ``problems``."""
        with self._lock:
            found, problems = self._stock
            tasks = [shelf.describe() for shelf in found.values() if not shelf.missing]
            return {"tasks": tasks, "problems": problems}

    def described(self, task: str) -> dict[str, Any]:
        """A task as the catalog has it, whether or not there is anything of it to show."""
        with self._lock:
            return self._shelf(task).describe()

    def default(self) -> Selection:
        """What a page shows first: the first of everything. Raises BadInput where there is nothing to show."""
        with self._lock:
            found, problems = self._stock
            shelf = next((shelf for shelf in found.values() if not shelf.missing), None)
            if shelf is None:
                raise BadInput("; ".join(problems) or "no trained filter is there to show; train one first.")
            (data, episodes), *_ = shelf.data.items()
            return Selection(shelf.task.name, next(iter(shelf.filters)), episodes.held_out()[0], data=data)

    def traced(self, selection: Selection) -> Traced:
        """The selection's trace, computed from now on if it is not there.

        Raises BadInput for what does not exist, and QueueFull.
        """
        if (live := self._live(selection)) is not None:
            return live
        with self._lock:
            known = self._living.get(self.key(selection))
            if known is None or (known.done.done() and known.done.exception() is not None):
                checkpoint, episode = self._found(selection)
                if self._waiting >= RUNS_WAITING:
                    raise QueueFull(f"{self._waiting} runs of filters wait already, no more are taken: ask again later")
                known = Traced(self.key(selection), checkpoint)
                self._waiting += 1
                self._tracing.submit(self._compute, known, selection, episode)
            self._keep(known)
            return known

    def there(self, selection: Selection) -> Traced | None:
        """The selection's trace if it is in memory and done. Nothing is computed for it."""
        if (live := self._live(selection)) is not None:
            return live
        with self._lock:
            known = self._living.get(self._keys.get(selection, ""))
            if known is None or not known.done.done() or known.done.exception() is not None:
                return None
            self._keep(known)
            return known

    def _keep(self, traced: Traced) -> None:
        """As the newest; the oldest ones go, unless somebody shows them."""
        self._living[traced.key] = self._traced[traced.key] = traced
        self._traced.move_to_end(traced.key)
        size = sum(one.nbytes for one in self._traced.values())
        while len(self._traced) > TRACES_IN_MEMORY or (size > BYTES_IN_MEMORY and len(self._traced) > 1):
            size -= self._traced.popitem(last=False)[1].nbytes

    def key(self, selection: Selection) -> str:
        """Hash of everything its trace depends on; the trace need not be there. Raises BadInput as ``traced``."""
        if (live := self._live(selection)) is not None:
            return live.key
        with self._lock:
            if selection not in self._keys:
                checkpoint, episode = self._found(selection)
                seed, particles = self.settings.seed, self.settings.particles
                parts = [checkpoint.hash, episode.digest(), seed, particles, str(selection.faults)]
                if selection.edit is not None:
                    parts.append(selection.edit.to_json())
                self._keys[selection] = hashlib.sha256(repr(tuple(parts)).encode()).hexdigest()
                while len(self._keys) > KEYS_KEPT:
                    self._keys.popitem(last=False)
            self._keys.move_to_end(selection)
            return self._keys[selection]

    def held_out(self, selection: Selection) -> list[Selection]:
        """The same of each episode that its data set holds out. Raises BadInput for an unknown task or data set."""
        with self._lock:
            episodes = self.dataset(selection.task, selection.data)[1].held_out()
            return [replace(selection, episode=episode) for episode in episodes]

    def filters(self, task: str) -> dict[str, Checkpoint]:
        """By name, all that there are of a task. Raises BadInput for an unknown one."""
        with self._lock:
            return self._shelf(task).filters

    def checkpoint(self, task: str, filter_: str) -> Checkpoint:
        """Raises BadInput for a name that is not here."""
        with self._lock:
            return self._shelf(task).filter(filter_)

    def dataset(self, task: str, name: str) -> tuple[str, Dataset]:
        """Name and data set; the task's first for an empty name. Raises BadInput for a name that is not here."""
        if name.startswith(PREFIX):
            raise BadInput(f"{name!r} is a live run: one episode, not a set of them")
        with self._lock:
            shelf = self._shelf(task)
            found = shelf.dataset(name)
            return name or next(iter(shelf.data)), found

    def data_hash(self, task: str, name: str) -> str:
        """Of a data set; worked out once, since some kinds have to read every episode for it."""
        with self._hashing:  # of its own: reading takes long, and others want the library meanwhile
            if (task, name) not in self._hashes:
                self._hashes[task, name] = self.dataset(task, name)[1].hash
            return self._hashes[task, name]

    def adopt(self, task: str, name: str, checkpoint: Checkpoint, path: Path, first: bool) -> None:
        """Puts a filter on its task's shelf, before all others or behind those given; jobs find it by its name too."""
        with self._lock:
            self._shelf(task).place(name, checkpoint, first)
            self.settings = replace(self.settings, checkpoints={**self.settings.checkpoints, name: path})

    def dismiss(self, task: str, name: str) -> None:
        """Takes it off again."""
        with self._lock:
            self._shelf(task).remove(name)
            others = {key: given for key, given in self.settings.checkpoints.items() if key != name}
            self.settings = replace(self.settings, checkpoints=others)

    def _found(self, selection: Selection) -> tuple[Checkpoint, Episode]:
        shelf = self._shelf(selection.task)
        checkpoint = shelf.filter(selection.filter)
        live = selection.data.startswith(PREFIX)
        episode = self.live.episode(selection.data) if live else shelf.episode(selection.data, selection.episode)
        selection.faults.check(checkpoint.task)
        if selection.edit is not None:
            selection.edit.faults.check(checkpoint.task)
        return checkpoint, episode

    def _live(self, selection: Selection) -> Traced | None:
        """The live run itself, where it is that which is asked for."""
        if not selection.data.startswith(PREFIX):
            return None
        return self.live.traced(selection, self.filters(selection.task))

    def _shelf(self, task: str) -> Shelf:
        found, _ = self._stock
        if task not in found:
            raise one_of("task", task, found)
        return found[task]

    def _compute(self, traced: Traced, selection: Selection, episode: Episode) -> None:
        def progress(fraction: float) -> None:
            if self._closing:
                raise CancelledError
            traced.progress = fraction

        with self._lock:
            self._waiting -= 1
        try:
            # The first page waits for the first run: it is here sooner than the other process is there.
            if self._tracer is not None and self._tracer.started:
                result = self._run_apart(self._tracer, selection, progress)
            elif selection.edit is None:
                result = self._run(traced.checkpoint, selection, episode, progress)
            else:
                result = self._edited(traced.checkpoint, selection, selection.edit, episode, progress)
            traced.done.set_result(result)
        except BaseException as error:
            traced.done.set_exception(error)
        if self._tracer is not None:
            with suppress(RuntimeError):  # the server is stopping
                self._tracer.start()

    def _file(self, selection: Selection) -> Path:
        return self.settings.workspace / "traces" / f"{selection.stem}-{self.key(selection)[:16]}.trace"

    def _run_apart(self, tracer: Tracer, selection: Selection, progress: Callable[[float], None]) -> Trace:
        """The trace from its file, which the other process writes where there is none that can be read."""
        path = self._file(selection)
        with suppress(BadInput):
            return load_trace(path)
        path.unlink(missing_ok=True)
        tracer.run(self.settings.to_json(), selection.to_json(), path, progress)
        try:
            return load_trace(path)
        finally:
            if selection.edit is not None:  # edits are tried by the dozen, and each is soon made again
                path.unlink(missing_ok=True)

    def _run(
        self, checkpoint: Checkpoint, selection: Selection, episode: Episode, progress: Callable[[float], None]
    ) -> Trace:
        """The trace from its file, or computed and written there."""
        path = self._file(selection)
        # A trace file that cannot be read is only a cache: it is computed and written again.
        with suppress(BadInput):
            return load_trace(path)
        result = trace(
            checkpoint,
            episode,
            episode_index=selection.episode,
            seed=self.settings.seed,
            particles=self.settings.particles,
            faults=selection.faults,
            progress=progress,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        save_trace(result, path)
        return result

    def _edited(
        self,
        checkpoint: Checkpoint,
        selection: Selection,
        edit: Edit,
        episode: Episode,
        progress: Callable[[float], None],
    ) -> Trace:
        """The run with an edit. It has no file: edits are tried by the dozen, and each is soon made again."""
        whole = replace(selection, edit=None)
        if self._replay is None or self._replay[0] != self.key(whole):
            original = self._run(checkpoint, whole, episode, progress)
            self._replay = self.key(whole), Replay(checkpoint, original, progress)
        return self._replay[1].edited(edit)

    def close(self) -> None:
        """Give up what is being computed and close the data sets."""
        self._closing = True
        if self._tracer is not None:
            self._tracer.close()
        self._tracing.shutdown(wait=True, cancel_futures=True)
        self.live.close()
        with self._lock:
            if "_stock" in vars(self):
                for shelf in self._stock[0].values():
                    shelf.close()

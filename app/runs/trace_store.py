"""The traces of a server, each computed once on first request; and the catalog of filters and data sets."""

import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import asdict, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

from beliefscope.app.protocol.errors import QueueFull
from beliefscope.app.runs.catalog import TaskCatalog, task_catalogs
from beliefscope.app.runs.examples import EXAMPLES, Example, available
from beliefscope.app.runs.live_runs import LIVE_PREFIX, LiveRuns, resolve_filter
from beliefscope.app.runs.result_filters import find_result_filter
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings, origin
from beliefscope.app.runs.trace_worker import RunRequest, TraceWorker
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.workspace.healthy_records import record_path, with_record
from beliefscope.app.workspace.json_files import RecordCache, read_record
from beliefscope.app.workspace.saved_filters import SavedFilters
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.initial_view import initial_view
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference, task_to_json
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.standalone import check_standalone
from beliefscope.inspect.stored_runs import StoredRuns
from beliefscope.inspect.trace import Trace, load_trace
from beliefscope.inspect.traces.live_run import LiveRun

TRACES_IN_MEMORY = 8  # most recent traces, in addition to those in use
BYTES_IN_MEMORY = 256 << 20  # of the most recent traces; one is kept whatever its size
MAX_WAITING = 64  # runs in the queue
MAX_KEYS = 4096  # selections with a cached key, a few hundred bytes each


class TraceStore:
    """Traces, filters and data sets of a server. Methods may be called from any thread, and may block."""

    def __init__(self, settings: Settings, worker: TraceWorker | None = None) -> None:
        """worker: process that runs the filters; without one, they run in a thread."""
        self.settings = settings
        self.live = LiveRuns(settings.workspace / "live", settings.definitions)
        self.saved = SavedFilters(settings.workspace, settings.definitions)
        # JSON of healthy profiles, measured by jobs for filters that have none.
        self._records = RecordCache(partial(read_record, dict[str, Any]))
        self._worker = worker
        self._lock = threading.RLock()
        self._key = lru_cache(MAX_KEYS)(self._compute_key)
        self._recent: OrderedDict[str, TracedRun] = OrderedDict()
        self._in_use: WeakValueDictionary[str, TracedRun] = WeakValueDictionary()  # includes runs that only views hold
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="tracing")
        self._runs = StoredRuns()  # used by the executor's thread only
        self._waiting = 0  # runs submitted to the executor and not started
        self._closing = False

    @cached_property
    def _catalogs(self) -> tuple[dict[str, TaskCatalog], list[str]]:
        settings = self.settings
        return task_catalogs(settings.checkpoints, settings.data, settings.definitions, self.saved)

    def problems(self) -> list[str]:
        """One line for each filter or data set of the settings that cannot be used."""
        with self._lock:
            return self._catalogs[1]

    def catalog(self, task: str = "", filters: Sequence[str] = ()) -> dict[str, Any]:
        """``tasks`` that can be displayed, the ``problems``, and ``examples``.

        task, filters: filters to include if a sweep or a study has them.
        """
        with self._lock:
            catalogs, problems = self._catalogs
            problems = list(problems)
            for name in filters if task in catalogs else ():
                try:
                    self._find_filter(task, name)
                except BadInput as error:
                    problems.append(str(error).removesuffix("."))
            tasks = [catalog.to_json() for catalog in catalogs.values() if not catalog.problem]
            return {"tasks": tasks, "problems": problems, "examples": list(map(asdict, self._examples()))}

    def tasks(self) -> list[str]:
        """Names of the tasks that can be displayed."""
        with self._lock:
            return [name for name, catalog in self._catalogs[0].items() if not catalog.problem]

    def describe_task(self, task: Task) -> dict[str, Any]:
        """The catalog entry of a task, whether or not this server has filters and data of it."""
        with self._lock:
            return self._catalogs[0].get(task.name, TaskCatalog(task)).to_json()

    def filters_of(self, run: LiveRun) -> dict[str, Checkpoint]:
        """The filters of a live run's task by name. Raises BadInput if another task here has the same name."""
        with self._lock:
            catalog = self._catalogs[0].get(run.task.name)
            if catalog is None:
                return {}
            if other := difference(catalog.task, run.task):
                raise BadInput(f"live run {run.name!r} has {other}, unlike task {run.task.name!r} of this server")
            return catalog.filters

    def default_selection(self) -> Selection:
        """The first example; without one, the first task and filter. Raises BadInput if no task can be displayed."""
        with self._lock:
            catalogs, problems = self._catalogs
            if example := next((example for example in self._examples() if not example.setup), None):
                catalog, filter_ = catalogs[example.task], example.filter
            else:
                first = next((catalog for catalog in catalogs.values() if not catalog.problem), None)
                if first is None:
                    raise BadInput("; ".join(problems) or "no trained filter is available; train one first")
                catalog, filter_ = first, next(iter(first.filters))
            data, episodes = next(iter(catalog.data.items()))
            return Selection(catalog.task.name, filter_, initial_view(episodes)[0], data=data)

    def _examples(self) -> list[Example]:
        """The examples, first those of the user's data.

        None for a server with filters, tasks or other data sets of the user.
        """
        catalogs, settings = self._catalogs[0], self.settings
        needed = {example.task for example in EXAMPLES if example.setup}
        own = {task: catalog.user_data for task, catalog in catalogs.items() if catalog.user_data}
        if settings.checkpoints or settings.tasks or own.keys() - needed:
            return []
        return sorted(available(catalogs), key=lambda example: example.task not in own)

    def request(self, selection: Selection) -> TracedRun:
        """The selected run; its computation is started if necessary.

        Raises BadInput if part of the selection does not exist, and QueueFull if too many runs are waiting.
        """
        if (live_run := self._live_run(selection)) is not None:
            return live_run
        with self._lock:
            key = self._key(selection)
            run = self._in_use.get(key)
            if run is None or self._is_outdated(run):
                if self._waiting >= MAX_WAITING:
                    raise QueueFull(f"{self._waiting} filter runs are waiting already; try again later")
                run = TracedRun(key, self.checkpoint(selection.task, selection.filter))
                self._waiting += 1
                self._executor.submit(self._compute, run, selection)
            self._remember(run)
            return run

    def _is_outdated(self, run: TracedRun) -> bool:
        """Whether the run failed, or the healthy record of its filter was measured after its start."""
        if run.future.done() and run.future.exception() is not None:
            return True
        record = self._records.get(record_path(self.settings.workspace, run.checkpoint))
        return record is not None and record is not run.checkpoint.healthy_profile

    def cached(self, selection: Selection) -> TracedRun | None:
        """The selected run if its trace is complete and in memory."""
        if (live_run := self._live_run(selection)) is not None:
            return live_run
        with self._lock:
            run = self._in_use.get(self._key(selection))
            if run is None or not run.future.done() or run.future.exception() is not None:
                return None
            self._remember(run)
            return run

    def key(self, selection: Selection) -> str:
        """Hash of everything the trace depends on. Raises BadInput as ``request`` does."""
        if (live_run := self._live_run(selection)) is not None:
            return live_run.key
        with self._lock:
            return self._key(selection)

    def filters(self, task: str) -> dict[str, Checkpoint]:
        """The filters of a task by name. Raises BadInput for an unknown task."""
        with self._lock:
            return self._catalog(task).filters

    def datasets(self, task: str) -> dict[str, Dataset]:
        """The data sets of a task by name. Raises BadInput for an unknown task."""
        with self._lock:
            return self._catalog(task).data

    def checkpoint(self, task: str, filter_: str) -> Checkpoint:
        """With the healthy record of the workspace, if it was measured. Raises BadInput for an unknown name."""
        with self._lock:
            checkpoint = self._find_filter(task, filter_)
            if checkpoint is None:
                raise unknown_name("filter", filter_, self._catalog(task).filters)
            return self._with_record(checkpoint)

    def _with_record(self, checkpoint: Checkpoint) -> Checkpoint:
        with self._lock:
            record = self._records.get(record_path(self.settings.workspace, checkpoint))
        return checkpoint if record is None else with_record(checkpoint, record)

    def record_version(self, checkpoint: Checkpoint) -> int | None:
        """Differs between measurements of the filter's record in the workspace; None without."""
        with self._lock:
            return self._records.modified(record_path(self.settings.workspace, checkpoint))

    def write_record(self, checkpoint: Checkpoint, record: dict[str, Any]) -> None:
        """Keep a healthy record of a filter in the workspace; replaces an earlier one."""
        with self._lock:
            self._records.put(record_path(self.settings.workspace, checkpoint), record)

    def dataset(self, task: str, name: str) -> tuple[str, Dataset]:
        """Name and data set; the task's first for an empty name. Raises BadInput for an unknown name."""
        if name.startswith(LIVE_PREFIX):
            raise BadInput(f"{name!r} is a live run: a single episode, not a data set")
        with self._lock:
            catalog = self._catalog(task)
            return name or next(iter(catalog.data)), catalog.dataset(name)

    def close(self) -> None:
        """Stop the computations and close the data sets."""
        self._closing = True
        if self._worker is not None:
            self._worker.close()
        self._executor.shutdown(wait=True, cancel_futures=True)
        self.live.close()
        with self._lock:
            for catalog in self._catalogs[0].values() if "_catalogs" in vars(self) else ():
                catalog.close()

    def _catalog(self, task: str) -> TaskCatalog:
        catalogs, _ = self._catalogs
        if task not in catalogs:
            raise unknown_name("task", task, catalogs)
        return catalogs[task]

    def _find_filter(self, task: str, name: str) -> Checkpoint | None:
        """A filter of the catalog, to which those of sweeps and studies are added; None if it does not exist.

        Raises BadInput for an unknown task, and if the file of a filter that only a sweep or a study has is missing or
        changed.
        """
        catalog = self._catalog(task)
        if name in (filters := catalog.filters):
            return filters[name]
        found = find_result_filter(task, name, self.settings)
        if found is not None:
            catalog.opened[name] = found
        return found

    def _live_run(self, selection: Selection) -> TracedRun | None:
        """The recorded live run, if the selection is exactly that run."""
        if not selection.data.startswith(LIVE_PREFIX):
            return None
        run = self.live[selection.data.removeprefix(LIVE_PREFIX)]
        name, checkpoint = resolve_filter(run, self.filters_of(run))
        return self.live.traced_run(run, selection, name, self._with_record(checkpoint))

    def _episode(self, selection: Selection) -> Episode:
        with self._lock:
            if selection.data.startswith(LIVE_PREFIX):
                return self.live.episode(selection.data)
            return self._catalog(selection.task).episode(selection.data, selection.episode)

    def _compute_key(self, selection: Selection) -> str:
        """Checks all parts of the selection: other functions rely on this."""
        checkpoint, episode = self.checkpoint(selection.task, selection.filter), self._episode(selection)
        selection.faults.check(checkpoint.task, len(episode))
        seed, particles = self.settings.seed, self.settings.particles
        parts = [checkpoint.hash, episode.digest(), seed, particles, str(selection.faults)]
        if selection.intervention is not None:
            selection.intervention.faults.check(checkpoint.task)
            parts.append(selection.intervention.to_json())
        if selection.only:
            check_standalone(checkpoint, selection.only)
            parts.append(f"only {selection.only}")
        return hashlib.sha256(repr(tuple(parts)).encode()).hexdigest()

    def _remember(self, run: TracedRun) -> None:
        """Make a run the most recent one, and drop the oldest ones that exceed the limits."""
        self._in_use[run.key] = self._recent[run.key] = run
        self._recent.move_to_end(run.key)
        size = sum(recent.nbytes for recent in self._recent.values())
        while len(self._recent) > TRACES_IN_MEMORY or (size > BYTES_IN_MEMORY and len(self._recent) > 1):
            size -= self._recent.popitem(last=False)[1].nbytes

    def _compute(self, run: TracedRun, selection: Selection) -> None:
        def progress(fraction: float) -> None:
            if self._closing:
                raise CancelledError
            run.progress = fraction

        with self._lock:
            self._waiting -= 1
        try:
            request = self._run_request(selection, run.checkpoint)
            # The first run is complete in this process before the worker has started.
            if self._worker is not None and self._worker.started and origin(run.checkpoint) is not None:
                result = _run_in_worker(self._worker, request, progress)
            else:
                episode = self._episode(selection)
                result = self._runs.run(run.checkpoint, episode, progress=progress, **request.settings())
            run.future.set_result(result)
        except BaseException as error:
            run.future.set_exception(error)
        if self._worker is not None:
            with suppress(RuntimeError):  # the server is stopping
                self._worker.start()

    def _run_request(self, selection: Selection, checkpoint: Checkpoint) -> RunRequest:
        with self._lock:
            data, live = selection.data, selection.data.startswith(LIVE_PREFIX)
            source = self.live.ended_run(data).reader if live else self._catalog(selection.task).dataset(data)
            original = str(self._trace_file(replace(selection, intervention=None, only="")))
            return RunRequest(
                **vars(selection),
                definition=json.dumps(task_to_json(checkpoint.task)),
                checkpoint=origin(checkpoint) or "",
                external=checkpoint.path is None,
                path=str(source.path),
                original=original,
                output=str(self._trace_file(selection)),
                seed=self.settings.seed,
                particles=self.settings.particles,
            )

    def _trace_file(self, selection: Selection) -> Path:
        return self.settings.workspace / "traces" / f"{selection.file_stem}-{self.key(selection)[:16]}.trace"


def store_of_job(arguments: Mapping[str, Any]) -> closing[TraceStore]:
    """The store in the process of a job, with the settings of the server; closed at the end of a block."""
    return closing(TraceStore(Settings.from_json(arguments["settings"])))


def _run_in_worker(worker: TraceWorker, request: RunRequest, progress: Callable[[float], None]) -> Trace:
    """The trace from its file; the worker writes the file if it is missing or unreadable."""
    path = Path(request.output)
    if path.is_file():
        with suppress(BadInput):
            return load_trace(path)
        path.unlink()
    if not request.external and not Path(request.checkpoint).is_file():
        raise BadInput(
            f"filter {request.filter!r} cannot run: its checkpoint {request.checkpoint!r} was deleted or moved; reload "
            "the page and select another filter"
        )
    worker.run(request, progress)
    try:
        return load_trace(path)
    finally:
        if request.output != request.original:  # traces of interventions and standalone runs are not kept
            path.unlink(missing_ok=True)

"""Queue of long tasks, run in processes: progress, cancellation and results in the workspace.

A job is a function listed in ``KINDS``, with JSON arguments and a JSON result; ``app/runs/worker.py`` runs it.
One process that has finished a job waits for the next one, which starts seconds sooner because all is imported.
The folder ``jobs/ID`` of a job holds ``job.json``, ``log.txt`` and, once it is done, ``result.json``.
"""

import hashlib
import json
import logging
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Literal

from pydantic import AliasChoices, ConfigDict, Field, with_config

from beliefscope import __version__
from beliefscope.app.jobs.remaining_time import RemainingTime
from beliefscope.app.protocol.errors import NotFound, QueueFull
from beliefscope.app.runs.worker import Report, WorkerDied, WorkerProcess, memory_in_use, redirect_output
from beliefscope.app.workspace.json_files import content, read_record
from beliefscope.app.workspace.paths import file_within
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io import user_code
from beliefscope.datasets.io.atomic_write import write_atomically, write_error
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.filters.legacy_names import SCORE, failure_result

KINDS: dict[str, str] = {
    "diagnosis": "beliefscope.app.jobs.diagnosis:run",
    "diagnostic": "beliefscope.app.jobs.diagnostic:run",
    "failures": "beliefscope.app.jobs.failures:run",
    "finetune": "beliefscope.app.jobs.finetune:run",
    "healthy": "beliefscope.app.jobs.diagnosis:measure_record",
    "reading": "beliefscope.app.jobs.recording:open_run",
    "recording": "beliefscope.app.jobs.recording:record",
    "repair": "beliefscope.app.jobs.diagnosis:search_repair",
    "report": "beliefscope.app.jobs.report:run",
    "study": "beliefscope.app.jobs.study:run",
}
"""Kind of job -> ``module:function`` of (arguments, report) -> result; see ``app/runs/worker.py``."""

MAX_RUNNING, MAX_WAITING, MAX_ENDED = 2, 16, 100  # jobs; the oldest ended ones are deleted
GRACE = 3.0  # s between SIGTERM and SIGKILL
LOG_TAIL = 8000  # bytes
REUSED_BELOW = 1 << 30  # bytes of memory, at most, of a process that waits for the next job

State = Literal["waiting", "running", "done", "failed", "cancelled", "interrupted"]
ACTIVE = ("waiting", "running")
REASONS: dict[State, str] = {"cancelled": "cancelled", "interrupted": "the server stopped"}

log = logging.getLogger("beliefscope.app")


@with_config(ConfigDict(json_schema_serialization_defaults_required=True))
@dataclass(frozen=True)
class Job:
    """State of one job.

    Attributes:
        id: hash of the kind and of everything the result depends on. title: shown to users.
        progress: 0..1. message: current activity, one line. error: why there is no result, one line.
        remaining: s from the last progress to the end; None if unknown.
        submitted, started, ended: s since 1970; None if that has not happened.
        server: process id of the server that runs the job. link: page address of the result (``?...``) or its file.
    """

    id: str
    kind: str
    title: str
    state: State = "waiting"
    progress: float = 0.0
    remaining: float | None = None
    message: str = ""
    error: str = ""
    # Files of earlier versions name it "asked".
    submitted: Annotated[float, Field(validation_alias=AliasChoices("submitted", "asked"))] = 0.0
    started: float | None = None
    ended: float | None = None
    server: int = 0
    link: str = ""

    @property
    def active(self) -> bool:
        """Whether the job waits or runs."""
        return self.state in ACTIVE


class Jobs:
    """The jobs of one server, including ended ones of earlier servers. Thread-safe.

    folder: of the job folders; created on first use. kinds: see ``KINDS``. max_running, max_waiting: limits. settings:
    of the server, as JSON; added to the arguments of each job.
    """

    def __init__(
        self,
        folder: Path,
        kinds: Mapping[str, str] = KINDS,
        max_running: int = MAX_RUNNING,
        max_waiting: int = MAX_WAITING,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self._folder, self._settings, self._kinds = folder, settings, kinds
        self._max_running, self._max_active = max_running, max_running + max_waiting
        self._lock = threading.RLock()
        self._executor = ThreadPoolExecutor(max_running, "job")
        self._processes: dict[str, WorkerProcess] = {}
        self._idle: WorkerProcess | None = None
        self._stopping: dict[str, State] = {}  # job being stopped -> its final state
        self._closing = False
        self._jobs: dict[str, Job] = {}
        for job in sorted(_read_jobs(folder), key=lambda job: job.submitted):
            if job.active:
                self._put(replace(job, state="interrupted", error=REASONS["interrupted"]))
            else:
                self._jobs[job.id] = job

    def all(self) -> list[Job]:
        """All jobs, newest first."""
        with self._lock:
            return sorted(self._jobs.values(), key=lambda job: -job.submitted)

    def __getitem__(self, id: str) -> Job:
        """The job with this id. Raises NotFound."""
        with self._lock:
            if id not in self._jobs:
                raise NotFound(f"Job {id!r} does not exist.")
            return self._jobs[id]

    def find(self, kind: str, key: object) -> Job | None:
        """The job submitted with this kind and key (or arguments), if any."""
        with self._lock:
            return self._jobs.get(_id(kind, key))

    def log(self, id: str) -> str:
        """The last lines of the job's output."""
        with suppress(OSError), (self._folder / id / "log.txt").open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LOG_TAIL))
            return file.read().decode(errors="replace")
        return ""

    def result(self, id: str) -> Path | None:
        """Path of the job's result (JSON), or None if there is none."""
        return file_within(self._folder, f"{id}/result.json")

    def finished_result(self, job: Job | None) -> Path | None:
        """Path of the result of a job that is done, else None."""
        return self.result(job.id) if job is not None and job.state == "done" else None

    def submit(
        self,
        kind: str,
        title: str,
        arguments: Mapping[str, Any],
        key: object = None,
        link: str = "",
        output_exists: bool = True,
    ) -> Job:
        """Queue a job, or return the existing one with the same kind and key if it is active or done.

        arguments: JSON, passed to the kind's function. key: everything the result depends on, compared by ``repr``; by
        default the arguments, which then have hashes of the files that the job reads. link: page address of the
        result. output_exists: False if files that the job wrote have been deleted.

        Raises BadInput for a full disk, and QueueFull.
        """
        id = _id(kind, arguments if key is None else key)
        with self._lock:
            existing = self._jobs.get(id)
            if existing is not None and (existing.active or (output_exists and self.finished_result(existing))):
                return existing
            if self._closing:
                raise BadInput("the server is stopping")
            active = sum(job.active for job in self._jobs.values())
            if active >= self._max_active:
                waiting = active - self._max_running
                raise QueueFull(f"{waiting} jobs are already waiting; cancel one or try again later")
            folder = self._folder / id
            shutil.rmtree(folder, ignore_errors=True)
            try:
                folder.mkdir(parents=True)
            except OSError as error:
                raise write_error(folder, error) from None
            # Keeps the order if the clock was set back.
            submitted = max([time.time(), *(job.submitted + 1e-3 for job in self._jobs.values())])
            job = Job(id, kind, title, submitted=submitted, server=os.getpid(), link=link)
            self._save(job)
            self._jobs[id] = job
            begun = threading.Event()
            self._executor.submit(self._run, id, {**arguments, "settings": self._settings}, begun)
            for job in [job for job in self.all() if not job.active][MAX_ENDED:]:
                self._delete(job.id)
        if active < self._max_running:
            begun.wait()
        return self[id]

    def cancel(self, id: str, only_active: bool = False) -> Job:
        """Cancel an active job; delete an ended one with its files, unless ``only_active``. Raises NotFound."""
        with self._lock:
            job = self[id]
            if job.state == "waiting":
                self._end(job, "cancelled")
            elif job.state == "running":
                self._stop(id, "cancelled")
            elif not only_active:
                self._delete(id)
                return job
            return self._jobs[id]

    def close(self) -> None:
        """Stop all active jobs; their state becomes ``interrupted``."""
        with self._lock:
            self._closing = True
            for job in self.all():
                if job.state == "waiting":
                    self._end(job, "interrupted")
            for id in self._processes:
                self._stop(id, "interrupted")
        self._executor.shutdown()
        if self._idle is not None:
            _end_process(self._idle)

    def _save(self, job: Job) -> None:
        write_atomically(self._folder / job.id / "job.json", json.dumps(asdict(job)).encode())

    def _put(self, job: Job) -> None:
        self._jobs[job.id] = job
        try:
            self._save(job)
        except BadInput as error:  # a full disk or a deleted folder: only a later server misses the job
            log.warning("job %s cannot be saved: %s", job.id, error)

    def _end(self, job: Job, state: State, error: str = "") -> Job:
        """Save a job that has ended. The clock may have been set back."""
        ended = max(time.time(), job.started or job.submitted)
        error = error or REASONS.get(state, "")
        self._put(replace(job, state=state, remaining=None, error=error, ended=ended))
        return self._jobs[job.id]

    def _delete(self, id: str) -> None:
        del self._jobs[id]
        shutil.rmtree(self._folder / id, ignore_errors=True)

    def _run(self, id: str, arguments: Mapping[str, Any], begun: threading.Event) -> None:
        """Run a job in a process, unless it has been cancelled. Sets the event once the job has left the queue."""
        with self._lock:
            begun.set()  # ``submit`` then waits for the lock
            job = self._jobs.get(id)
            if job is None or job.state != "waiting":
                return
            try:
                process = self._processes[id] = self._process(self._folder / id / "log.txt")
            except OSError as error:  # deleted folder, or no memory or file descriptors left
                self._end(job, "failed", f"it could not be started: {error.strerror or error}")
                return
            self._put(replace(job, state="running", message="starting", started=max(time.time(), job.submitted)))
            log.info("job started", extra={"event": {"job": id, "kind": job.kind, "title": job.title}})
        failure = self._call(id, process, arguments)
        with self._lock:
            del self._processes[id]
            stopped = self._stopping.pop(id, None)
            if not failure and self.result(id):
                job = self._end(replace(self._jobs[id], progress=1.0, message=""), "done")
            elif stopped:
                job = self._end(self._jobs[id], stopped)
            else:
                job = self._end(self._jobs[id], "failed", failure or "its result was deleted")
        seconds = round((job.ended or 0.0) - (job.started or 0.0), 1)
        event = {"job": id, "kind": job.kind, "state": job.state, "seconds": seconds, "error": job.error}
        log.log(logging.WARNING if job.state == "failed" else logging.INFO, "job ended", extra={"event": event})

    def _call(self, id: str, process: WorkerProcess, arguments: Mapping[str, Any]) -> str:
        """Run the job's function in the process, and end the process. Returns the error, or an empty text."""
        time_left = RemainingTime()

        def report(progress: float, message: str) -> None:
            remaining = time_left.update(progress, time.monotonic())
            with self._lock:
                self._jobs[id] = replace(self._jobs[id], progress=progress, remaining=remaining, message=message)

        call = {"function": self._kinds[self._jobs[id].kind], "folder": str(self._folder / id), "arguments": arguments}
        reusable = False
        try:
            reusable = process.call("run_job", call, report)
        except WorkerDied as error:
            last_line = next((line for line in reversed(self.log(id).splitlines()) if line.strip()), "").strip()
            return f"{error}; last output: {last_line}" if last_line else str(error)
        except (BadInput, RuntimeError) as error:
            return str(error)
        finally:
            with self._lock:
                keep = reusable and self._idle is None and id not in self._stopping and not self._closing
                if keep:
                    self._idle = process
            if not keep:
                _end_process(process)
        return ""

    def _process(self, log: Path) -> WorkerProcess:
        """The waiting process, or a new one; its printed text goes to the file."""
        log.touch()
        process, self._idle = self._idle, None
        if process is not None and process.poll() is None:
            return process
        with log.open("wb") as output:
            return WorkerProcess(__name__, output)

    def _stop(self, id: str, state: State) -> None:
        if id in self._stopping:
            return
        self._stopping[id] = state
        process = self._processes[id]
        process.signal_group(signal.SIGTERM)
        threading.Thread(target=_kill_after_grace, args=(process,), name=f"stopping job {id}", daemon=True).start()


def run_job(arguments: Mapping[str, Any], report: Report) -> bool:
    """Run the function of a job in its process and write the result.

    Returns whether the process may run another job: not after user code, which may have changed by then.
    """
    folder = Path(arguments["folder"])
    redirect_output(folder / "log.txt")
    result = resolve_name(arguments["function"])(arguments["arguments"], report)
    write_atomically(folder / "result.json", json.dumps(result, allow_nan=False).encode())
    return not user_code.has_run() and memory_in_use() < REUSED_BELOW


def _id(kind: str, key: object) -> str:
    return hashlib.sha256(repr((kind, key, __version__)).encode()).hexdigest()[:16]


def _read_jobs(folder: Path) -> list[Job]:
    """The stored jobs, except jobs that are active in another server."""
    jobs = []
    for path in folder.glob("*/job.json"):
        # Skips files that are damaged or of another version.
        with suppress(OSError, ValueError, TypeError, LookupError, AttributeError):
            job = read_record(Job, path)
            if job.id == path.parent.name and not (job.active and _is_other_process(job.server)):
                jobs.append(job)
                if job.kind == "failures" and (result := file_within(folder, f"{job.id}/result.json")):
                    _rename_keys(result)
    return jobs


def _rename_keys(path: Path) -> None:
    """Rewrite the result of a failure job if an earlier version stored it with other keys."""
    data = content(path)
    if any(f'"{key}"'.encode() in data for key in SCORE):
        write_atomically(path, json.dumps(failure_result(read_json(data))).encode())


def _is_other_process(pid: int) -> bool:
    if pid <= 0 or pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _end_process(process: WorkerProcess) -> None:
    with process:  # closes its pipes
        process.signal_group(signal.SIGKILL)  # with remaining subprocesses


def _kill_after_grace(process: WorkerProcess) -> None:
    with suppress(subprocess.TimeoutExpired):
        process.wait(GRACE)
        return
    process.signal_group(signal.SIGKILL)

"""Long work, each in a process of its own: queued, watched, cancelled, and its result kept in the workspace.

A job is a function of ours, named in ``KINDS``, with JSON arguments and a JSON result (``app/jobs/worker.py`` runs it).
Its folder ``jobs/ID`` holds ``job.json``, ``arguments.json``, ``log.txt`` and, once it is done, ``result.json``.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from fastapi import APIRouter, HTTPException
from fastapi.responses import FileResponse, JSONResponse, Response
from pydantic import TypeAdapter

from beliefscope import __version__
from beliefscope.app.jobs.worker import how_it_ended
from beliefscope.app.server.security import kept_file
from beliefscope.app.workspace.json_files import read_record
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.io.atomic_write import unwritable, write_atomically

KINDS: dict[str, str] = {
    "diagnostic": "beliefscope.app.api.diagnostics:work",
    "failures": "beliefscope.app.api.failures:work",
    "finetune": "beliefscope.app.api.finetune:work",
    "reading": "beliefscope.app.api.recordings:work",
    "recording": "beliefscope.app.api.recordings:write",
    "report": "beliefscope.app.api.reports:work",
    "study": "beliefscope.app.api.studies:work",
}
"""Kind of job -> ``module:function`` of (arguments, report) -> result; ``report(share done, what it is doing)``."""

AT_ONCE, WAITING, KEPT = 2, 16, 100  # running, queued, and finished jobs that are remembered
GRACE = 3.0  # s that a process has to end before it is killed
LOG_TAIL = 8000  # bytes

State = Literal["waiting", "running", "done", "failed", "cancelled", "interrupted"]
UNDER_WAY = ("waiting", "running")
WORKER = "beliefscope.app.jobs.worker"

log = logging.getLogger("beliefscope.app")


class QueueFull(BadInput):
    """So many jobs wait already that another one is not taken."""


@dataclass(frozen=True)
class Job:
    """One job as it is now.

    Attributes:
        id: hash of its kind and of all that its result depends on. title: for people.
        progress: 0..1. message: what it is doing, in a line. error: why it ended without a result, in a line.
        asked, started, ended: s since 1970; None where it has not come to that.
        server: process id of the server that has it. link: from the page's root to its result: ``?...``, or a file.
    """

    id: str
    kind: str
    title: str
    state: State = "waiting"
    progress: float = 0.0
    message: str = ""
    error: str = ""
    asked: float = 0.0
    started: float | None = None
    ended: float | None = None
    server: int = 0
    link: str = ""


RECORD = TypeAdapter(Job)


class Jobs:
    """The jobs of one server, and those that earlier ones left in its workspace. Methods may be called from any thread.

    Args:
        folder: where they are kept; made when the first one is asked for.
        kinds: as ``KINDS``. at_once, waiting: how many run and how many wait at most.
    """

    def __init__(
        self, folder: Path, kinds: Mapping[str, str] = KINDS, at_once: int = AT_ONCE, waiting: int = WAITING
    ) -> None:
        self._folder, self._kinds, self._at_once, self._waiting = folder, kinds, at_once, waiting
        self._lock = threading.RLock()
        self._queue: deque[str] = deque()
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._attending: dict[str, threading.Thread] = {}
        self._stopped: dict[str, State] = {}  # whose process was told to end, and what it is then
        self._closing = False
        self._jobs: dict[str, Job] = {}
        for job in sorted(_read_all(folder), key=lambda job: job.asked):
            unfinished = job.state in UNDER_WAY
            self._put(replace(job, state="interrupted", error="the server stopped") if unfinished else job, unfinished)

    def all(self) -> list[Job]:
        """All of them, the newest first."""
        with self._lock:
            return sorted(self._jobs.values(), key=lambda job: -job.asked)

    def __getitem__(self, id: str) -> Job:
        """Raises KeyError for one that is not there."""
        with self._lock:
            return self._jobs[id]

    def find(self, kind: str, key: str) -> Job | None:
        """The job that was asked for with this kind and key, if any was."""
        with self._lock:
            return self._jobs.get(_id(kind, key))

    def log(self, id: str) -> str:
        """The end of what it printed."""
        with suppress(OSError), (self._folder / id / "log.txt").open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LOG_TAIL))
            return file.read().decode(errors="replace")
        return ""

    def result(self, id: str) -> Path | None:
        """Where its result is, JSON; None where there is none, or a link to what lies elsewhere."""
        return kept_file(self._folder, f"{id}/result.json")

    def submit(
        self,
        kind: str,
        title: str,
        arguments: Mapping[str, Any],
        key: str,
        link: str = "",
        there: bool = True,
    ) -> Job:
        """Has it done; one that is under way, or done with what it made still there, is not done again.

        Args:
            arguments: JSON, handed to the kind's function. key: hash of all that the result depends on.
            link: to see the result on the page, from its ``?`` on. there: whether what it made besides still is.

        Raises BadInput for an unknown kind, and QueueFull.
        """
        if kind not in self._kinds:
            raise one_of("kind of job", kind, self._kinds)
        id = _id(kind, key)
        with self._lock:
            known = self._jobs.get(id)
            if known is not None and known.state in UNDER_WAY:
                return known
            if known is not None and known.state == "done" and there and self.result(id):
                return known
            if self._closing:
                raise BadInput("the server is stopping")
            if len(self._queue) >= self._waiting:
                raise QueueFull(f"{len(self._queue)} jobs wait already, no more are taken: cancel one, or wait")
            folder = self._folder / id
            shutil.rmtree(folder, ignore_errors=True)
            try:
                folder.mkdir(parents=True)
            except OSError as error:
                raise unwritable(folder, error) from None
            write_atomically(folder / "arguments.json", json.dumps(arguments).encode())
            # A clock that was set back must not put what is asked for now behind what was.
            asked = max([time.time(), *(job.asked + 1e-3 for job in self._jobs.values())])
            self._put(Job(id, kind, title, asked=asked, server=os.getpid(), link=link))
            self._queue.append(id)
            self._start()
            self._tidy()
            return self._jobs[id]

    def cancel(self, id: str) -> Job:
        """Ends it, or takes it out of the queue; one that has ended is forgotten with its files.

        Raises KeyError for one that is not there.
        """
        with self._lock:
            job = self._jobs[id]
            if job.state == "waiting":
                self._queue.remove(id)
                self._put(replace(job, state="cancelled", error="cancelled", ended=time.time()))
            elif job.state == "running":
                self._stop(id, "cancelled")
            else:
                self._forget(id)
                return job
            return self._jobs[id]

    def close(self) -> None:
        """Ends what runs; that and what waits is interrupted."""
        with self._lock:
            self._closing = True
            for id in self._queue:
                self._put(replace(self._jobs[id], state="interrupted", error="the server stopped", ended=time.time()))
            self._queue.clear()
            for id in list(self._processes):
                self._stop(id, "interrupted")
            attending = list(self._attending.values())
        for thread in attending:
            thread.join(2 * GRACE)

    def _put(self, job: Job, write: bool = True) -> None:
        self._jobs[job.id] = job
        if write:
            try:
                write_atomically(self._folder / job.id / "job.json", json.dumps(asdict(job)).encode())
            except BadInput as error:  # a full disk, or a folder that is gone: only a later server misses it
                log.warning("Job %s is not kept: %s", job.id, error)

    def _forget(self, id: str) -> None:
        del self._jobs[id]
        shutil.rmtree(self._folder / id, ignore_errors=True)

    def _tidy(self) -> None:
        for job in [job for job in self.all() if job.state not in UNDER_WAY][KEPT:]:
            self._forget(job.id)

    def _start(self) -> None:
        while self._queue and len(self._processes) < self._at_once:
            id = self._queue.popleft()
            job = self._jobs[id]
            try:
                process = self._processes[id] = self._process(job)
            except OSError as error:  # its folder is gone, or there is no memory for a process, or no descriptor
                why = f"it could not be started: {error.strerror or error}"
                self._put(replace(job, state="failed", error=why, ended=max(time.time(), job.asked)))
                continue
            self._put(replace(job, state="running", started=max(time.time(), job.asked)))
            log.info("job began", extra={"event": {"job": id, "kind": job.kind, "title": job.title}})
            self._attending[id] = threading.Thread(target=self._attend, args=(id, process), name=f"job {id}")
            self._attending[id].start()

    def _process(self, job: Job) -> subprocess.Popen[bytes]:
        # A session of its own: Ctrl-C in the terminal is for the server, and what a job starts ends with it.
        with (self._folder / job.id / "log.txt").open("wb") as said:
            return subprocess.Popen(
                [
                    sys.executable,
                    "-P",
                    "-m",
                    WORKER,
                    self._kinds[job.kind],
                    self._folder / job.id,
                ],
                stdin=subprocess.PIPE,  # when it closes, its server is gone
                stdout=subprocess.PIPE,
                stderr=said,
                start_new_session=True,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )

    def _attend(self, id: str, process: subprocess.Popen[bytes]) -> None:
        hearing = threading.Thread(target=self._hear, args=(id, process), name=f"hearing {id}")
        hearing.start()
        code = process.wait()
        _signal(process, signal.SIGKILL)  # whatever it started
        hearing.join()
        assert process.stdin is not None
        process.stdin.close()
        with self._lock:
            del self._processes[id], self._attending[id]
            job = self._jobs[id]
            job = replace(job, ended=max(time.time(), job.started or 0.0))
            stopped = self._stopped.pop(id, None)
            if code == 0 and self.result(id):
                job = replace(job, state="done", progress=1.0, message="", error="")
            elif stopped:
                error = "cancelled" if stopped == "cancelled" else "the server stopped"
                job = replace(job, state=stopped, error=error)
            else:
                job = replace(job, state="failed", error=job.error or self._why(id, code))
            self._put(job)
            told = {"job": id, "kind": job.kind, "state": job.state, "seconds": _seconds(job), "error": job.error}
            log.log(logging.WARNING if job.state == "failed" else logging.INFO, "job ended", extra={"event": told})
            if not self._closing:
                self._start()

    def _hear(self, id: str, process: subprocess.Popen[bytes]) -> None:
        """Takes what the process reports, JSON lines of a job's fields, until it ends."""
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                # The last line of a process that was killed may be half a line.
                with suppress(ValueError), self._lock:
                    self._put(replace(self._jobs[id], **json.loads(line)), write=False)

    def _why(self, id: str, code: int) -> str:
        """What is known of a process that ended without saying why."""
        last = next((line for line in reversed(self.log(id).splitlines()) if line.strip()), "")
        how = f"its process {how_it_ended(code)}"
        return f"{how}; it said last: {last.strip()}" if last else how

    def _stop(self, id: str, then: State) -> None:
        if id in self._stopped:
            return
        self._stopped[id] = then
        process = self._processes[id]
        _signal(process, signal.SIGTERM)
        threading.Thread(target=_end, args=(process,), name=f"ending {id}", daemon=True).start()


def routes(jobs: Jobs) -> APIRouter:
    """Every route under ``/api/jobs``."""
    router = APIRouter()

    def known(id: str) -> Job:
        try:
            return jobs[id]
        except KeyError:
            raise HTTPException(404, f"Job {id!r} does not exist.") from None

    @router.get("/api/jobs")
    def list_jobs() -> list[Job]:
        return jobs.all()

    @router.get("/api/jobs/{id}")
    def one_job(id: str) -> dict[str, Any]:
        return asdict(known(id)) | {"log": jobs.log(id)}

    @router.delete("/api/jobs/{id}")
    def cancel(id: str) -> Job:
        known(id)
        return jobs.cancel(id)

    @router.get("/api/jobs/{id}/result")
    def result(id: str) -> Response:
        job = known(id)
        path = jobs.result(id)
        if job.state != "done" or path is None:
            raise HTTPException(404, f"Job {id!r} has no result: it is {job.state}{job.error and f', {job.error}'}.")
        return FileResponse(path, media_type="application/json")

    return router


def under_way(job: Job | None) -> JSONResponse:
    """The answer where a job has to end first; None where nobody asked for it."""
    return JSONResponse({"job": None if job is None else asdict(job)}, status_code=202)


def _seconds(job: Job) -> float:
    """How long it ran."""
    return round((job.ended or 0.0) - (job.started or 0.0), 1)


def _id(kind: str, key: str) -> str:
    return hashlib.sha256(repr((kind, key, __version__)).encode()).hexdigest()[:16]


def _read_all(folder: Path) -> list[Job]:
    """The jobs that lie there, but for those that another running server has under way."""
    found = []
    for path in folder.glob("*/job.json"):
        # A file that cannot be read, or is of another version, is no job of ours.
        with suppress(OSError, ValueError, TypeError):
            job = read_record(RECORD, path)
            if job.id == path.parent.name and not (job.state in UNDER_WAY and _lives_elsewhere(job.server)):
                found.append(job)
    return found


def _lives_elsewhere(pid: int) -> bool:
    if pid <= 0 or pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """To the process and all that it started."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


def _end(process: subprocess.Popen[bytes]) -> None:
    with suppress(subprocess.TimeoutExpired):
        process.wait(GRACE)
        return
    _signal(process, signal.SIGKILL)

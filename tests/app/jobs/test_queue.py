"""Job queue: results, progress, cancellation, crashes and restarts."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.responses import JSONResponse
from starlette.testclient import TestClient

from beliefscope.app.api.jobs import add_routes
from beliefscope.app.jobs.queue import KINDS, Job, Jobs
from beliefscope.app.protocol.errors import NotFound, QueueFull
from beliefscope.datasets.errors import BadInput

pytestmark = pytest.mark.slow

FUNCTIONS = ("add", "wait", "crash", "vanish", "refuse", "not_json", "load")
TEST_KINDS = {name: f"job_functions:{name}" for name in FUNCTIONS}
TIMEOUT = 60.0  # s

OpenJobs = Callable[..., Jobs]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "jobs"


@pytest.fixture
def open_jobs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[OpenJobs]:
    """Opens the folder like a starting server."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    opened: list[Jobs] = []

    def open_(**limits: int) -> Jobs:
        opened.append(Jobs(folder, TEST_KINDS, **limits))
        return opened[-1]

    yield open_
    for jobs in opened:
        jobs.close()


def wait_until(condition: Callable[[], Any]) -> Any:
    end = time.monotonic() + TIMEOUT
    while not (value := condition()):
        assert time.monotonic() < end
        time.sleep(0.01)
    return value


def wait_for(jobs: Jobs, id: str) -> Job:
    wait_until(lambda: jobs[id].ended)
    return jobs[id]


def is_alive(pid: int) -> bool:
    """Whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):  # before or after opening the file
        return False


class Waiting:
    """A job that runs until a file exists."""

    def __init__(self, jobs: Jobs, folder: Path, name: str) -> None:
        self.started, self.until = folder / f"{name}.started", folder / f"{name}.until"
        arguments = {"started": str(self.started), "until": str(self.until)}
        self.id = jobs.submit("wait", f"Wait for {name}", arguments, name).id

    @property
    def pids(self) -> list[int]:
        wait_until(lambda: self.started.exists() and self.started.read_text().count(" "))
        return [int(pid) for pid in self.started.read_text().split()]


def test_result_is_stored_and_reused(open_jobs: OpenJobs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    jobs = open_jobs()
    job = jobs.submit("add", "Add", {"numbers": [1, 2, 3]}, "one to three")
    done = wait_for(jobs, job.id)
    assert (done.state, done.progress, done.error) == ("done", 1.0, "")
    result = jobs.result(job.id)
    assert result
    assert json.loads(result.read_bytes()) == {"sum": 6, "threads": "1"}
    assert jobs.log(job.id) == "adding\n"
    assert done.submitted <= done.started <= done.ended
    assert jobs.submit("add", "Add", {"numbers": [1, 2, 3]}, "one to three") == done
    assert jobs.find("add", "one to three") == done
    assert jobs.find("add", "one to four") is None
    assert jobs.submit("add", "Add", {"numbers": [4]}, "one to four").id != job.id


def test_a_process_is_reused_but_not_after_an_error_or_user_code(open_jobs: OpenJobs, tmp_path: Path) -> None:
    jobs = open_jobs()
    code = tmp_path / "user.py"
    code.write_text("VALUE = 5")

    def run(kind: str, key: str, **arguments: object) -> tuple[int | None, str]:
        """Process that waits after the job, and the output of the job."""
        id = wait_for(jobs, jobs.submit(kind, kind, {"numbers": [], **arguments}, key).id).id
        return jobs._idle and jobs._idle.pid, jobs.log(id)

    first, log = run("add", "a")
    assert first
    assert log == "adding\n"
    assert run("add", "b") == (first, "adding\n")
    waiting, log = run("crash", "")
    assert waiting is None
    assert log.startswith("about to divide\nTraceback")
    assert run("add", "c")[0] not in (None, first)
    assert run("load", "", place=str(code)) == (None, "5\n")


def test_progress_and_cancellation(open_jobs: OpenJobs, tmp_path: Path) -> None:
    jobs = open_jobs()
    job = Waiting(jobs, tmp_path, "a")
    pids = job.pids
    wait_until(lambda: jobs[job.id].message == "waiting for the file")
    assert (jobs[job.id].state, jobs[job.id].progress) == ("running", 0.25)
    assert 0.0 < jobs[job.id].remaining < TIMEOUT
    jobs.cancel(job.id)
    assert (wait_for(jobs, job.id).state, jobs[job.id].remaining) == ("cancelled", None)
    wait_until(lambda: not any(map(is_alive, pids)))
    assert jobs.cancel(job.id, only_active=True).state == "cancelled"
    assert [each.id for each in jobs.all()] == [job.id], "a job that ended just before stays"
    jobs.cancel(job.id)  # deletes an ended job
    assert jobs.all() == []
    assert not (tmp_path / "jobs" / job.id).exists()


@pytest.mark.parametrize(
    ("kind", "error", "log"),
    [
        ("crash", "ZeroDivisionError: division by zero", "Traceback"),
        ("vanish", "its process ended with exit code 3; last output: exiting without an error", "exiting"),
        ("refuse", "particles must be at least 1, not 0", ""),
        ("not_json", "ValueError: Out of range float values are not JSON compliant", "not_json|json"),
    ],
)
def test_error_is_reported_and_job_can_be_repeated(open_jobs: OpenJobs, kind: str, error: str, log: str) -> None:
    jobs = open_jobs()
    first = jobs.submit(kind, kind, {"numbers": []}, "")
    failed = wait_for(jobs, first.id)
    assert failed.state == "failed"
    assert failed.error.startswith(error)
    assert any(part in jobs.log(first.id) for part in log.split("|"))
    assert not jobs.result(first.id)
    again = jobs.submit(kind, kind, {"numbers": []}, "")
    assert again.id == first.id
    assert again.state in ("waiting", "running")


def test_killed_process_does_not_affect_others(open_jobs: OpenJobs, tmp_path: Path) -> None:
    jobs = open_jobs(max_running=2)
    killed, other = Waiting(jobs, tmp_path, "a"), Waiting(jobs, tmp_path, "b")
    pid, child = killed.pids
    other.pids  # noqa: B018 - waits until it runs
    os.kill(pid, signal.SIGKILL)
    failed = wait_for(jobs, killed.id)
    assert failed.state == "failed"
    assert "signal 9 (SIGKILL), possibly out of memory" in failed.error
    wait_until(lambda: not is_alive(child))
    assert jobs[other.id].state == "running"
    other.until.touch()
    assert wait_for(jobs, other.id).state == "done"


def test_limits_of_running_and_waiting_jobs(open_jobs: OpenJobs, tmp_path: Path) -> None:
    jobs = open_jobs(max_running=1, max_waiting=2)
    first, second, third = (Waiting(jobs, tmp_path, name) for name in "abc")
    wait_until(lambda: jobs[first.id].started)
    assert [jobs[job.id].state for job in (first, second, third)] == ["running", "waiting", "waiting"]
    with pytest.raises(QueueFull, match="2 jobs are already waiting"):
        Waiting(jobs, tmp_path, "d")
    assert jobs.submit("wait", "", {}, "b").id == second.id
    assert jobs.cancel(second.id).state == "cancelled"
    first.until.touch()
    assert wait_for(jobs, first.id).state == "done"
    third.until.touch()
    assert wait_for(jobs, third.id).state == "done"
    assert jobs[second.id].started is None
    assert not second.started.exists()
    assert [job.title[-1] for job in jobs.all()] == ["c", "b", "a"]


def test_restart_keeps_results_and_interrupts_active_jobs(open_jobs: OpenJobs, tmp_path: Path) -> None:
    jobs = open_jobs(max_running=1)
    done = wait_for(jobs, jobs.submit("add", "Add", {"numbers": [2, 3]}, "").id)
    running, waiting = Waiting(jobs, tmp_path, "a"), Waiting(jobs, tmp_path, "b")
    pids = running.pids
    concurrent = open_jobs()  # as after the server was killed: same process id
    assert [job.state for job in concurrent.all()] == ["interrupted", "interrupted", "done"]
    jobs.close()
    wait_until(lambda: not any(map(is_alive, pids)))
    again = open_jobs()
    assert again.all()[-1] == done
    result = again.result(done.id)
    assert result
    assert json.loads(result.read_bytes())["sum"] == 5
    assert [(again[job.id].state, again[job.id].error) for job in (running, waiting)] == [
        ("interrupted", "the server stopped")
    ] * 2
    with pytest.raises(BadInput, match="the server is stopping"):
        jobs.submit("add", "Add", {"numbers": []}, "late")


def test_jobs_of_other_servers_and_damaged_files_are_ignored(open_jobs: OpenJobs, folder: Path) -> None:
    jobs = open_jobs()
    done = wait_for(jobs, jobs.submit("add", "Add", {"numbers": []}, "").id)
    other = folder / "other"
    other.mkdir()
    record = json.dumps(vars(done) | {"id": "other", "state": "running", "server": os.getppid()})
    (other / "job.json").write_text(record)
    (folder / "half").mkdir()
    (folder / "half" / "job.json").write_text('{"id": "ha')
    assert open_jobs().all() == [done]
    assert (other / "job.json").read_text() == record


def test_job_ends_with_its_server(open_jobs: OpenJobs, tmp_path: Path) -> None:
    jobs = open_jobs()
    job = Waiting(jobs, tmp_path, "a")
    pid, _ = job.pids
    stdin = jobs._processes[job.id].stdin
    assert stdin is not None
    stdin.close()  # as at the end of the server's process
    wait_until(lambda: not is_alive(pid))


def test_routes(open_jobs: OpenJobs, tmp_path: Path) -> None:
    jobs = open_jobs()
    app = FastAPI()
    add_routes(app, jobs)
    app.add_exception_handler(NotFound, lambda _, error: JSONResponse({"error": str(error)}, 404))
    with TestClient(app) as client:
        assert client.get("/api/jobs").json() == []
        done = wait_for(jobs, jobs.submit("add", "Add up", {"numbers": [1]}, "").id)
        waiting = Waiting(jobs, tmp_path, "a")
        assert [(job["title"], job["state"]) for job in client.get("/api/jobs").json()] == [
            ("Wait for a", "running"),
            ("Add up", "done"),
        ]
        assert client.get(f"/api/jobs/{done.id}").json()["log"] == "adding\n"
        assert client.get(f"/api/jobs/{done.id}/result").json()["sum"] == 1
        answer = client.get(f"/api/jobs/{waiting.id}/result")
        assert (answer.status_code, "it is running" in answer.text) == (404, True)
        assert client.delete(f"/api/jobs/{waiting.id}").status_code == 200
        assert wait_for(jobs, waiting.id).state == "cancelled"
        for method in ("GET", "DELETE"):
            assert client.request(method, "/api/jobs/nope").status_code == 404
        assert client.delete(f"/api/jobs/{done.id}").json()["state"] == "done"
        assert [job["title"] for job in client.get("/api/jobs").json()] == ["Wait for a"]


def test_functions_of_all_kinds_exist() -> None:
    for kind in KINDS.values():
        module, _, name = kind.partition(":")
        assert callable(getattr(import_module(module), name))


def test_record_of_an_earlier_version(folder: Path, open_jobs: OpenJobs) -> None:
    (folder / "a").mkdir(parents=True)
    record = {"id": "a", "kind": "add", "title": "Add", "state": "done", "asked": 5.0}
    (folder / "a" / "job.json").write_text(json.dumps(record))
    assert open_jobs()["a"].submitted == 5.0


@pytest.mark.parametrize("result", ['["shown"]', '{"shown": 1}', '{"scores": ["shown"]}', '{"scores": "shown'])
def test_a_damaged_result_of_an_earlier_version_does_not_stop_the_server(
    folder: Path, open_jobs: OpenJobs, result: str
) -> None:
    (folder / "a").mkdir(parents=True)
    (folder / "a" / "job.json").write_text(json.dumps(asdict(Job("a", "failures", "Failures", "done"))))
    (folder / "a" / "result.json").write_text(result)
    assert [job.id for job in open_jobs().all()] == ["a"]
    assert (folder / "a" / "result.json").read_text() == result

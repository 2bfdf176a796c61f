"""Long work in processes of its own: real ones, cancelled, killed, crashed, and found again."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from beliefscope.app.jobs.queue import Job, Jobs, QueueFull, routes
from beliefscope.datasets.errors import BadInput

KINDS = {name: f"job_functions:{name}" for name in ("add", "wait", "crash", "vanish", "refuse", "hopeless")}
PATIENCE = 60.0  # s: a process of Python with torch takes seconds to start on a busy machine

Open = Callable[..., Jobs]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "jobs"


@pytest.fixture
def opened(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Open]:
    """Opens the folder as a server that starts does."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    all_: list[Jobs] = []

    def open_(**limits: int) -> Jobs:
        all_.append(Jobs(folder, KINDS, **limits))
        return all_[-1]

    yield open_
    for jobs in all_:
        jobs.close()


def until(condition: Callable[[], Any]) -> Any:
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.01)
    return found


def ended(jobs: Jobs, id: str) -> Job:
    until(lambda: jobs[id].ended)
    return jobs[id]


def alive(pid: int) -> bool:
    """Whether a process is there and no corpse that nobody has buried yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


class Waiting:
    """A job that runs until it is let go."""

    def __init__(self, jobs: Jobs, folder: Path, name: str) -> None:
        self.started, self.until = folder / f"{name}.started", folder / f"{name}.until"
        arguments = {"started": str(self.started), "until": str(self.until)}
        self.id = jobs.submit("wait", f"Wait for {name}", arguments, name).id

    @property
    def pids(self) -> list[int]:
        until(lambda: self.started.exists() and self.started.read_text().count(" "))
        return [int(pid) for pid in self.started.read_text().split()]


def test_a_job_gives_its_result_and_is_not_done_twice(opened: Open) -> None:
    jobs = opened()
    job = jobs.submit("add", "Add", {"numbers": [1, 2, 3]}, "one to three")
    done = ended(jobs, job.id)
    assert (done.state, done.progress, done.error) == ("done", 1.0, "")
    result = jobs.result(job.id)
    assert result
    assert json.loads(result.read_bytes()) == {"sum": 6, "threads": "1"}
    assert jobs.log(job.id) == "adding\n"
    assert done.asked <= done.started <= done.ended
    assert jobs.submit("add", "Add", {"numbers": [1, 2, 3]}, "one to three") == done
    assert jobs.find("add", "one to three") == done
    assert jobs.find("add", "one to four") is None
    assert jobs.submit("add", "Add", {"numbers": [4]}, "one to four").id != job.id


def test_progress_is_told_and_cancelling_ends_all_its_processes(opened: Open, tmp_path: Path) -> None:
    jobs = opened()
    job = Waiting(jobs, tmp_path, "a")
    pids = job.pids
    until(lambda: jobs[job.id].message == "waiting for the file")
    assert (jobs[job.id].state, jobs[job.id].progress) == ("running", 0.25)
    jobs.cancel(job.id)
    assert ended(jobs, job.id).state == "cancelled"
    until(lambda: not any(map(alive, pids)))
    jobs.cancel(job.id)  # one that has ended is forgotten
    assert jobs.all() == []
    assert not (tmp_path / "jobs" / job.id).exists()


@pytest.mark.parametrize(
    ("kind", "why", "log"),
    [
        ("crash", "ZeroDivisionError: division by zero", "Traceback"),
        ("vanish", "its process ended with exit code 3; it said last: leaving without a word", "leaving"),
        ("refuse", "particles must be at least 1, not 0", ""),
        ("hopeless", "ValueError: Out of range float values are not JSON compliant", "hopeless|json"),
    ],
)
def test_a_crash_says_why_and_can_be_tried_again(opened: Open, kind: str, why: str, log: str) -> None:
    jobs = opened()
    first = jobs.submit(kind, kind, {"numbers": []}, "")
    failed = ended(jobs, first.id)
    assert failed.state == "failed"
    assert failed.error.startswith(why)
    assert any(part in jobs.log(first.id) for part in log.split("|"))
    assert not jobs.result(first.id)
    again = jobs.submit(kind, kind, {"numbers": []}, "")
    assert again.id == first.id
    assert again.state in ("waiting", "running")


def test_a_killed_process_leaves_the_others_alone(opened: Open, tmp_path: Path) -> None:
    jobs = opened(at_once=2)
    killed, other = Waiting(jobs, tmp_path, "a"), Waiting(jobs, tmp_path, "b")
    pid, child = killed.pids
    other.pids  # noqa: B018 - wait until it runs
    os.kill(pid, signal.SIGKILL)
    failed = ended(jobs, killed.id)
    assert failed.state == "failed"
    assert "signal 9 (SIGKILL), perhaps for want of memory" in failed.error
    until(lambda: not alive(child))
    assert jobs[other.id].state == "running"
    other.until.touch()
    assert ended(jobs, other.id).state == "done"


def test_one_runs_the_rest_wait_and_too_many_are_refused(opened: Open, tmp_path: Path) -> None:
    jobs = opened(at_once=1, waiting=2)
    first, second, third = (Waiting(jobs, tmp_path, name) for name in "abc")
    assert [jobs[job.id].state for job in (first, second, third)] == ["running", "waiting", "waiting"]
    with pytest.raises(QueueFull, match="2 jobs wait already"):
        Waiting(jobs, tmp_path, "d")
    assert jobs.submit("wait", "", {}, "b").id == second.id  # asked for again: the same one
    assert jobs.cancel(second.id).state == "cancelled"
    first.until.touch()
    assert ended(jobs, first.id).state == "done"
    third.until.touch()
    assert ended(jobs, third.id).state == "done"
    assert jobs[second.id].started is None
    assert not second.started.exists()
    assert [job.title[-1] for job in jobs.all()] == ["c", "b", "a"]
    with pytest.raises(BadInput, match=r"kind of job 'dig' does not exist\. Available: add, wait"):
        jobs.submit("dig", "", {}, "")


def test_results_outlive_the_server_and_what_was_under_way_is_interrupted(opened: Open, tmp_path: Path) -> None:
    jobs = opened(at_once=1)
    done = ended(jobs, jobs.submit("add", "Add", {"numbers": [2, 3]}, "").id)
    running, waiting = Waiting(jobs, tmp_path, "a"), Waiting(jobs, tmp_path, "b")
    pids = running.pids
    while_it_runs = opened()  # as after a server that was killed: its process id is this one's
    assert [job.state for job in while_it_runs.all()] == ["interrupted", "interrupted", "done"]
    jobs.close()
    until(lambda: not any(map(alive, pids)))
    again = opened()
    assert again.all()[-1] == done
    result = again.result(done.id)
    assert result
    assert json.loads(result.read_bytes())["sum"] == 5
    assert [(again[job.id].state, again[job.id].error) for job in (running, waiting)] == [
        ("interrupted", "the server stopped")
    ] * 2
    with pytest.raises(BadInput, match="the server is stopping"):
        jobs.submit("add", "Add", {"numbers": []}, "late")


def test_another_servers_jobs_and_damaged_files_are_left_alone(opened: Open, folder: Path) -> None:
    jobs = opened()
    done = ended(jobs, jobs.submit("add", "Add", {"numbers": []}, "").id)
    other = folder / "other"
    other.mkdir()
    theirs = json.dumps(vars(done) | {"id": "other", "state": "running", "server": os.getppid()})
    (other / "job.json").write_text(theirs)
    (folder / "half").mkdir()
    (folder / "half" / "job.json").write_text('{"id": "ha')
    assert opened().all() == [done]
    assert (other / "job.json").read_text() == theirs


def test_a_job_ends_when_its_server_is_gone(opened: Open, tmp_path: Path) -> None:
    jobs = opened()
    job = Waiting(jobs, tmp_path, "a")
    pid, _ = job.pids
    stdin = jobs._processes[job.id].stdin
    assert stdin is not None
    stdin.close()  # as the system does for a server that was killed
    until(lambda: not alive(pid))


def test_over_http(opened: Open, tmp_path: Path) -> None:
    jobs = opened()
    app = FastAPI()
    app.include_router(routes(jobs))
    with TestClient(app) as client:
        assert client.get("/api/jobs").json() == []
        done = ended(jobs, jobs.submit("add", "Add up", {"numbers": [1]}, "").id)
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
        assert ended(jobs, waiting.id).state == "cancelled"
        for method in ("GET", "DELETE"):
            assert client.request(method, "/api/jobs/nope").status_code == 404
        assert client.delete(f"/api/jobs/{done.id}").json()["state"] == "done"
        assert [job["title"] for job in client.get("/api/jobs").json()] == ["Wait for a"]

"""Environment faults: full disk, missing permissions, deleted files, clock changes, lost connections."""

from __future__ import annotations

import os
import resource
import shutil
import socket
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import httpx
import numpy as np
import pytest
import torch
from starlette.testclient import TestClient
from websockets.sync.client import connect

from beliefscope.app.jobs import queue as jobs_module
from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app
from beliefscope.app.views.registry import Views
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.inspect.trace import Trace, save_trace, trace
from beliefscope.recordings.rerun_log.training_curves import tuning_curves
from beliefscope.recordings.write import write_recording

pytestmark = pytest.mark.slow

TIMEOUT = 60.0  # s


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Limit the size of files, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def wait_until(condition: Callable[[], Any]) -> Any:
    end = time.monotonic() + TIMEOUT
    while not (value := condition()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return value


def poll(client: TestClient, url: str) -> Any:
    """The response of a route once it is not 202."""
    return wait_until(lambda: (response := client.get(url)).status_code != 202 and response)


@pytest.fixture(scope="module")
def run() -> Trace:
    with open_dataset(sample_path("door")) as data:
        return trace(load_checkpoint(pretrained_path("door", "crossmodal-pf")), data[9], episode_index=9, particles=50)


WRITERS: dict[str, Callable[[Trace, Path], object]] = {
    "episodes": lambda run, path: write_dataset(path, DOOR, [run.episode]),
    "trace": lambda run, path: save_trace(run, path),
    "checkpoint": lambda run, path: save_checkpoint(
        load_checkpoint(pretrained_path("door", "crossmodal-pf")).filter, "crossmodal-pf", {}, path
    ),
}


@pytest.mark.parametrize("name", WRITERS)
def test_full_disk_keeps_existing_file(name: str, run: Trace, tmp_path: Path) -> None:
    path = tmp_path / "file"
    WRITERS[name](run, path)
    before = path.read_bytes()

    def write() -> None:
        with file_size_limit(10_000):
            WRITERS[name](run, path)

    (line,) = errors_in_fork(write)
    assert str(path) in line
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path], "no partial file is left"


@pytest.mark.skipif(os.geteuid() != 0, reason="mount needs root")
@pytest.mark.parametrize("name", WRITERS)
def test_full_disk_is_reported_with_free_space(name: str, run: Trace, tmp_path: Path) -> None:
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(place)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mount is not permitted")
    try:
        (place / "other").write_bytes(bytes(40_000))
        (line,) = errors_in_fork(partial(WRITERS[name], run, place / "new"))
        # Six of 16 pages of 4 KiB are free after the partial file is deleted.
        assert line == f"cannot write {str(place / 'new')!r}: No space left on device, 0.0 MB are free there"
        assert [path.name for path in place.iterdir()] == ["other"]
    finally:
        subprocess.run(["umount", str(place)], check=True)


@pytest.mark.first(2)
@pytest.mark.parametrize("share", [0.001, 0.01, 0.3, 0.98])
def test_recording_on_a_full_disk(share: float, run: Trace, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"  # Rerun does not support forks
    size = write_recording(run, path).stat().st_size
    path.unlink()
    message = r"cannot write .*run\.rrd': File too large"
    with file_size_limit(int(share * size)), pytest.raises(BadInput, match=message):
        write_recording(run, path)
    assert not list(tmp_path.iterdir())
    assert write_recording(run, path).is_file()


def test_training_curves_on_a_full_disk(tmp_path: Path) -> None:
    with (
        file_size_limit(1000),
        pytest.raises(BadInput, match=r"cannot write .*run-1\.rrd': File too large"),
        tuning_curves(tmp_path) as write,
    ):
        write(0, {"loss": 0.5})


def errors_in_fork(*functions: Callable[[], object], user: int | None = None) -> list[str]:
    """Messages of BadInput raised by the functions in a fork of this process, optionally as another user."""
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            if user is not None:
                os.setuid(user)
            for function in functions:
                try:
                    function()
                    message = "no error"
                except BadInput as error:
                    message = str(error)
                except BaseException as error:
                    message = f"{type(error).__name__}, not BadInput: {error}"
                os.write(writing, f"{message}\n".encode())
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        lines = pipe.read().splitlines()
    os.waitpid(pid, 0)
    return lines


def test_server_with_a_full_disk(client: TestClient, trace_url: str, settings: Settings) -> None:
    with file_size_limit(100):
        refused = client.post("/api/failures/door/crossmodal-pf")
        assert refused.status_code == 400
        assert "cannot write" in refused.json()["error"]
        assert client.get(trace_url).status_code == 200
        assert client.get("/api/catalog").status_code == 200
    assert client.post("/api/failures/door/crossmodal-pf").status_code == 202
    (job,) = client.get("/api/jobs").json()
    client.delete(f"/api/jobs/{job['id']}")


def test_job_without_its_folder_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_jobs(tmp_path, monkeypatch) as jobs:
        waiting = jobs.submit("wait", "Wait", {"started": str(tmp_path / "a"), "until": str(tmp_path / "b")}, "1")
        wait_until((tmp_path / "a").exists)
        shutil.rmtree(tmp_path / "jobs")
        (tmp_path / "b").touch()
        assert wait_until(lambda: jobs[waiting.id].ended and jobs[waiting.id]).state == "failed"
        assert run_job(jobs, "2").state == "done", "other jobs are unaffected"


def test_job_that_cannot_start_does_not_block_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its folder was deleted while it was waiting."""
    with open_jobs(tmp_path, monkeypatch, max_running=1) as jobs:
        first = jobs.submit("wait", "Wait", {"started": str(tmp_path / "a"), "until": str(tmp_path / "b")}, "1")
        deleted, last = (jobs.submit("add", "Add", {"numbers": [1, 2]}, key) for key in ("2", "3"))
        wait_until((tmp_path / "a").exists)
        shutil.rmtree(tmp_path / "jobs" / deleted.id)
        (tmp_path / "b").touch()
        assert wait_until(lambda: jobs[last.id].ended and jobs[last.id]).state == "done"
        assert jobs[first.id].state == "done"
        assert (jobs[deleted.id].state, jobs[deleted.id].error) == (
            "failed",
            "it could not be started: No such file or directory",
        )


def test_folder_without_write_permission(run: Trace) -> None:
    """As user ``nobody`` if the tests run as root."""
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-pf"))
    writers = WRITERS | {"checkpoint": lambda run, path: save_checkpoint(checkpoint.filter, "f", {}, path)}
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o555)
        functions = [partial(write, run, Path(place) / name) for name, write in writers.items()]
        lines = errors_in_fork(*functions, user=None if os.geteuid() else 65534)
        assert len(lines) == len(writers)
        for line in lines:
            assert "annot write" in line
            assert place in line
        assert not list(Path(place).iterdir())


def test_deleted_workspace(client: TestClient, trace_url: str, settings: Settings, tmp_path: Path) -> None:
    body = {"task": "door", "filter": "crossmodal-pf", "episode": 1}
    response = client.post("/api/recordings", json=body)
    assert response.status_code == 201, response.text
    recording = response.json()
    shutil.rmtree(settings.workspace)
    assert client.get(trace_url).status_code == 200
    missing = client.get(recording["url"])
    assert missing.status_code == 404
    assert recording["name"] in missing.json()["error"]
    assert poll(client, trace_url.replace("/1", "/0")).status_code == 200, "the workspace is created again"


def test_missing_input_files_are_reported(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    data = {**settings.data, "missing": tmp_path / "missing.h5"}
    with open_client(replace(settings, data=data)) as client:
        catalog = client.get("/api/catalog").json()
    assert [line for line in catalog["problems"] if "missing.h5 does not exist" in line]
    assert "mine" in [entry["name"] for entry in catalog["tasks"][0]["data"]]


def test_a_data_set_with_nan_in_its_first_episode_leaves_the_others_available(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    with open_dataset(sample_path("door")) as data:
        write_dataset(tmp_path / "damaged.h5", DOOR, [data[9]])
    with h5py.File(tmp_path / "damaged.h5", "r+") as file:
        stored = file["trajectory0/observations/force"]
        force = stored[...]
        force[17] = np.nan
        stored[...] = force
    data_of = {"damaged": tmp_path / "damaged.h5", **settings.data}
    with open_client(replace(settings, data=data_of)) as client:
        catalog = client.get("/api/catalog").json()
    message = "'observations/force' of trajectory0 is nan at step 17, expected finite numbers"
    assert catalog["problems"] == [f"{tmp_path / 'damaged.h5'}: {message}"]
    assert next(entry["name"] for entry in catalog["tasks"][0]["data"]) == "mine"


def add_scaled_filter(settings: Settings, path: Path, value: float) -> Settings:
    """The settings with a filter whose weights are multiplied by ``value``."""
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with torch.no_grad():
        for parameter in checkpoint.filter.parameters():
            parameter.mul_(value)
    save_checkpoint(checkpoint.filter, "scaled", {}, path)
    return replace(settings, checkpoints={**settings.checkpoints, "scaled": path})


def test_filter_with_nan_weights_is_refused(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    with open_client(add_scaled_filter(settings, tmp_path / "nan.safetensors", float("nan"))) as client:
        catalog = client.get("/api/catalog").json()
        assert [line for line in catalog["problems"] if "not finite numbers" in line]
        assert "crossmodal-pf" in [entry["name"] for entry in catalog["tasks"][0]["filters"]]


def test_filter_that_overflows(settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path) -> None:
    """NaN estimates are displayed and cause no server error."""
    with open_client(add_scaled_filter(settings, tmp_path / "inf.safetensors", 1e18)) as client:
        url = "/api/trace/door/scaled/1"
        assert poll(client, url).status_code < 500
        for part in ("columns", "images"):
            assert client.get(f"{url}/{part}").status_code < 500
        for entry in client.get("/api/diagnostics").json():
            if not entry["slow"]:
                response = client.get(f"/api/diagnostics/{entry['name']}/door/scaled/1")
                assert response.status_code < 500, response.text
        view = client.post("/api/views").json()
        cursor = {"type": "cursor", "serial": 1, "task": "door", "filter": "scaled", "episode": 1, "step": 3}
        with client.websocket_connect(view["socket"]) as page:
            page.send_json(cursor | {"scene": True})
            message = page.receive()
            assert "The server failed" not in str(message.get("text"))
        assert poll(client, "/api/trace/door/crossmodal-pf/1").status_code == 200


@contextmanager
def open_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, max_running: int = 2) -> Iterator[Jobs]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "jobs"), prepend=os.pathsep)
    kinds = {name: f"job_functions:{name}" for name in ("add", "wait", "exhaust_memory")}
    jobs = Jobs(tmp_path / "jobs", kinds, max_running)
    try:
        yield jobs
    finally:
        jobs.close()


def run_job(jobs: Jobs, key: str, kind: str = "add") -> Job:
    id = jobs.submit(kind, kind, {"numbers": [1, 2]}, key).id
    return wait_until(lambda: jobs[id].ended and jobs[id])


def test_job_out_of_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_jobs(tmp_path, monkeypatch) as jobs:
        job = run_job(jobs, "1", "exhaust_memory")
        assert (job.state, job.error.partition(":")[0]) == ("failed", "it ran out of memory")
        assert run_job(jobs, "2").state == "done"


def test_order_of_jobs_after_clock_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs_module, "MAX_ENDED", 2)
    now = time.time()
    with open_jobs(tmp_path, monkeypatch) as jobs:
        for key in ("1", "2", "3"):
            monkeypatch.setattr(jobs_module.time, "time", lambda now=now: now)
            last = run_job(jobs, key)
            assert last.state == "done"
            assert last.started is not None
            assert last.ended is not None
            assert last.submitted <= last.started <= last.ended
            now -= 86400.0
        assert jobs.all()[0] == last, "the newest is first and is not deleted"


def test_reset_connection(settings: Settings, address: str) -> None:
    """The connection is reset, as by a router after a machine was suspended."""
    origin = f"http://{address}"
    client = httpx.Client(base_url=origin, headers={"Origin": origin}, timeout=TIMEOUT)
    views = [client.post("/api/views").json() for _ in range(2)]
    sockets = [connect(f"ws://{address}{view['socket']}", origin=origin, open_timeout=TIMEOUT) for view in views]  # type: ignore[arg-type]
    reset, other = sockets
    reset.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    reset.send('{"type": "cursor", "serial": 1, "task": "door", "filter": "crossmodal-pf", "episode": 1, "step": 1}')
    reset.socket.close()
    other.send('{"type": "unknown", "serial": 7}')
    assert '"serial":7' in str(other.recv(timeout=TIMEOUT)).replace(" ", "")
    other.close()
    client.close()


@pytest.mark.anyio
async def test_idle_view_is_closed(settings: Settings) -> None:
    application = create_app(settings, warm=False)
    views = Views(application.state.store, timeout=0.0)
    view = await views.open(dark=False)
    assert len(views) == 1
    await views._close_idle(keep=0, idle_for=0.0)
    assert len(views) == 0
    with pytest.raises(NotFound):
        views[view.name]

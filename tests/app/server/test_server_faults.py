"""What befalls a server that runs for days: no room, no right, files that go, networks that are broken, a wrong clock.

Each is made to happen to the real thing. What is asked for then is refused in one clear line, and the rest goes on.
"""

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

import httpx
import pytest
import torch
from starlette.testclient import TestClient
from websockets.sync.client import connect

from beliefscope.app.jobs import queue as jobs_module
from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app
from beliefscope.app.views.registry import Views
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint, shipped
from beliefscope.inspect.trace import Trace, save_trace, trace
from beliefscope.recordings.write import write_recording

PATIENCE = 60.0  # s


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """No file of this process may grow beyond so many bytes, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def until(condition: Callable[[], Any]) -> Any:
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return found


def answer(client: TestClient, url: str) -> Any:
    """The answer of a route that computes, once it has."""
    return until(lambda: (got := client.get(url)).status_code != 202 and got)


@pytest.fixture(scope="module")
def run() -> Trace:
    with open_dataset(sample_path("door")) as data:
        return trace(load_checkpoint(shipped("door", "crossmodal-pf")), data[9], episode_index=9, particles=50)


WRITERS: dict[str, Callable[[Trace, Path], object]] = {
    "episodes": lambda run, path: write_dataset(path, DOOR, [run.episode]),
    "trace": lambda run, path: save_trace(run, path),
    "checkpoint": lambda run, path: save_checkpoint(
        load_checkpoint(shipped("door", "crossmodal-pf")).filter, "crossmodal-pf", {}, path
    ),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line_and_leaves_what_was_there(name: str, run: Trace, tmp_path: Path) -> None:
    path = tmp_path / "kept"
    WRITERS[name](run, path)
    before = path.read_bytes()

    def write() -> None:
        with room_for(10_000):
            WRITERS[name](run, path)

    (line,) = apart(write)
    assert str(path) in line
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path], "nothing half-written is left"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount a disk")
@pytest.mark.parametrize("name", WRITERS)
def test_a_disk_without_room_is_told_with_what_is_free(name: str, run: Trace, tmp_path: Path) -> None:
    place = tmp_path / "disk"
    place.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(place)]
    if subprocess.run(mounted, capture_output=True, check=False).returncode:
        pytest.skip("no disk can be mounted here")
    try:
        (place / "other").write_bytes(bytes(40_000))
        (line,) = apart(partial(WRITERS[name], run, place / "wanted"))
        # 16 pages of 4 KiB, of which the other file has ten: six are left, once what was half written is gone.
        assert line == f"cannot write {str(place / 'wanted')!r}: No space left on device, 0.0 MB are free there"
        assert [path.name for path in place.iterdir()] == ["other"]
    finally:
        subprocess.run(["umount", str(place)], check=True)


@pytest.mark.long  # in a process that wrote other recordings before, Rerun may wait for ever
def test_a_recording_on_a_full_disk_is_one_line_too(run: Trace, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"  # not in a fork, for which Rerun is not made
    with room_for(10_000), pytest.raises(BadInput, match=r"cannot write .*run\.rrd': .* MB are free there"):
        write_recording(run, path)
    assert not list(tmp_path.iterdir())
    assert write_recording(run, path).is_file()


def apart(*works: Callable[[], object], user: int | None = None) -> list[str]:
    """What BadInput says of each, in lines, in a fork of this process, which may be another user's."""
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            if user is not None:
                os.setuid(user)
            for work in works:
                try:
                    work()
                    said = "nothing"
                except BadInput as error:
                    said = str(error)
                except BaseException as error:
                    said = f"{type(error).__name__}, not BadInput: {error}"
                os.write(writing, f"{said}\n".encode())
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        lines = pipe.read().splitlines()
    os.waitpid(pid, 0)
    return lines


def test_a_server_with_a_full_disk_says_so_and_goes_on(client: TestClient, trace_url: str, settings: Settings) -> None:
    with room_for(100):
        refused = client.post("/api/failures/door/crossmodal-pf")
        assert refused.status_code == 400
        assert "cannot write" in refused.json()["error"]
        assert client.get(trace_url).status_code == 200
        assert client.get("/api/catalog").status_code == 200
    assert client.post("/api/failures/door/crossmodal-pf").status_code == 202
    (job,) = client.get("/api/jobs").json()
    client.delete(f"/api/jobs/{job['id']}")


def test_a_job_whose_folder_is_gone_ends_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with working(tmp_path, monkeypatch) as jobs:
        waiting = jobs.submit("wait", "Wait", {"started": str(tmp_path / "a"), "until": str(tmp_path / "b")}, "1")
        until((tmp_path / "a").exists)
        shutil.rmtree(tmp_path / "jobs")
        (tmp_path / "b").touch()
        assert until(lambda: jobs[waiting.id].ended and jobs[waiting.id]).state == "failed"
        assert done(jobs, "2").state == "done", "others go on"


def test_a_job_that_cannot_be_started_does_not_hold_up_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its folder is gone by the time that it is its turn, as where somebody clears the workspace."""
    with working(tmp_path, monkeypatch, at_once=1) as jobs:
        first = jobs.submit("wait", "Wait", {"started": str(tmp_path / "a"), "until": str(tmp_path / "b")}, "1")
        gone, last = (jobs.submit("add", "Add", {"numbers": [1, 2]}, key) for key in ("2", "3"))
        until((tmp_path / "a").exists)
        shutil.rmtree(tmp_path / "jobs" / gone.id)
        (tmp_path / "b").touch()
        assert until(lambda: jobs[last.id].ended and jobs[last.id]).state == "done"
        assert jobs[first.id].state == "done"
        assert (jobs[gone.id].state, jobs[gone.id].error) == (
            "failed",
            "it could not be started: No such file or directory",
        )


def test_a_folder_that_cannot_be_written_is_one_line(run: Trace) -> None:
    """As nobody, where the tests are run by root, who may write everywhere."""
    checkpoint = load_checkpoint(shipped("door", "crossmodal-pf"))
    writers = WRITERS | {"checkpoint": lambda run, path: save_checkpoint(checkpoint.filter, "f", {}, path)}
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o555)
        works = [partial(write, run, Path(place) / name) for name, write in writers.items()]
        lines = apart(*works, user=None if os.geteuid() else 65534)
        assert len(lines) == len(writers)
        for line in lines:
            assert "annot write" in line
            assert place in line
        assert not list(Path(place).iterdir())


def test_files_deleted_under_a_server(client: TestClient, trace_url: str, settings: Settings, tmp_path: Path) -> None:
    asked = {"task": "door", "filter": "crossmodal-pf", "episode": 1}
    said = client.post("/api/recordings", json=asked)
    assert said.status_code == 201, said.text
    made = said.json()
    shutil.rmtree(settings.workspace)
    assert client.get(trace_url).status_code == 200
    gone = client.get(made["url"])
    assert gone.status_code == 404
    assert made["name"] in gone.json()["error"]
    assert answer(client, trace_url.replace("/1", "/0")).status_code == 200, "the workspace is made again"


def test_given_files_that_are_gone_are_named_and_the_rest_is_shown(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    data = {**settings.data, "gone": tmp_path / "gone.h5"}
    with open_client(replace(settings, data=data)) as client:
        catalog = client.get("/api/catalog").json()
    assert [line for line in catalog["problems"] if "gone.h5 does not exist" in line]
    assert "mine" in [one["name"] for one in catalog["tasks"][0]["data"]]


def broken(settings: Settings, path: Path, value: float) -> Settings:
    """The settings with a filter whose weights have gone wrong."""
    checkpoint = load_checkpoint(shipped("door", "crossmodal-ekf"))
    with torch.no_grad():
        for parameter in checkpoint.filter.parameters():
            parameter.mul_(value)
    save_checkpoint(checkpoint.filter, "broken", {}, path)
    return replace(settings, checkpoints={**settings.checkpoints, "broken": path})


def test_a_network_of_nan_is_refused_and_the_others_are_shown(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    with open_client(broken(settings, tmp_path / "nan.safetensors", float("nan"))) as client:
        catalog = client.get("/api/catalog").json()
        assert [line for line in catalog["problems"] if "no finite numbers" in line]
        assert "crossmodal-pf" in [one["name"] for one in catalog["tasks"][0]["filters"]]


def test_a_network_that_overflows_shows_what_there_is(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    """Its estimates are NaN. That is what the page is to show, not an error of the server."""
    with open_client(broken(settings, tmp_path / "inf.safetensors", 1e18)) as client:
        url = "/api/trace/door/broken/1"
        assert answer(client, url).status_code < 500
        for part in ("columns", "images"):
            assert client.get(f"{url}/{part}").status_code < 500
        for entry in client.get("/api/diagnostics").json():
            if not entry["slow"]:
                got = client.get(f"/api/diagnostics/{entry['name']}/door/broken/1")
                assert got.status_code < 500, got.text
        view = client.post("/api/views").json()
        cursor = {"type": "cursor", "serial": 1, "task": "door", "filter": "broken", "episode": 1, "step": 3}
        with client.websocket_connect(view["socket"]) as page:
            page.send_json(cursor | {"scene": True})
            said = page.receive()
            assert "The server failed" not in str(said.get("text"))
        assert answer(client, "/api/trace/door/crossmodal-pf/1").status_code == 200


@contextmanager
def working(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int = 2) -> Iterator[Jobs]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "jobs"))
    kinds = {name: f"job_functions:{name}" for name in ("add", "wait", "hungry")}
    jobs = Jobs(tmp_path / "jobs", kinds, at_once)
    try:
        yield jobs
    finally:
        jobs.close()


def done(jobs: Jobs, key: str, kind: str = "add") -> Job:
    id = jobs.submit(kind, kind, {"numbers": [1, 2]}, key).id
    return until(lambda: jobs[id].ended and jobs[id])


def test_a_job_out_of_memory_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with working(tmp_path, monkeypatch) as jobs:
        hungry = done(jobs, "1", "hungry")
        assert (hungry.state, hungry.error.partition(":")[0]) == ("failed", "it ran out of memory")
        assert done(jobs, "2").state == "done"


def test_a_clock_that_jumps_back_neither_loses_nor_reorders_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs_module, "KEPT", 2)
    now = time.time()
    with working(tmp_path, monkeypatch) as jobs:
        for key in ("1", "2", "3"):
            monkeypatch.setattr(jobs_module.time, "time", lambda now=now: now)
            last = done(jobs, key)
            assert last.state == "done"
            assert last.started is not None
            assert last.ended is not None
            assert last.asked <= last.started <= last.ended
            now -= 86400.0
        assert jobs.all()[0] == last, "the newest comes first, and is not what is forgotten"


def test_a_browser_that_vanishes_leaves_nothing_open(settings: Settings, address: str) -> None:
    """Its connection is cut without a word, as when a machine sleeps or a cable is pulled and the router answers."""
    origin = f"http://{address}"
    client = httpx.Client(base_url=origin, headers={"Origin": origin}, timeout=PATIENCE)
    views = [client.post("/api/views").json() for _ in range(2)]
    sockets = [connect(f"ws://{address}{view['socket']}", origin=origin, open_timeout=PATIENCE) for view in views]  # type: ignore[arg-type]
    vanishing, staying = sockets
    vanishing.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    vanishing.send(
        '{"type": "cursor", "serial": 1, "task": "door", "filter": "crossmodal-pf", "episode": 1, "step": 1}'
    )
    vanishing.socket.close()
    staying.send('{"type": "nothing", "serial": 7}')
    assert '"serial":7' in str(staying.recv(timeout=PATIENCE)).replace(" ", "")
    staying.close()
    client.close()


@pytest.mark.anyio
async def test_a_view_whose_page_has_gone_is_closed_after_a_while(settings: Settings) -> None:
    application = create_app(settings, warm=False)
    views = Views(application.state.store, timeout=0.0)
    view = await views.open(dark=False)
    assert len(views) == 1
    await views._close_idle(keep=0, idle_for=0.0)
    assert len(views) == 0
    with pytest.raises(KeyError):
        views[view.name]

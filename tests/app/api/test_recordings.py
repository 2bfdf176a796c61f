"""Recordings over HTTP: write, upload, rename, delete and restore."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
import rerun as rr
from starlette.testclient import TestClient

from beliefscope.app.api import recordings
from beliefscope.app.runs.settings import Settings
from beliefscope.app.workspace import trash
from beliefscope.app.workspace.recordings import checked
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.inspect.trace import trace
from beliefscope.recordings.probe import RecordingInfo, RecordingProbe
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.rerun_log.metadata import describe
from beliefscope.recordings.write import write_recording

pytestmark = pytest.mark.slow

URL = "/api/recordings"
TIMEOUT = 60.0  # s, including the import of Rerun by the reader


@pytest.fixture(scope="session")
def run_recording(base_settings: Settings, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording of the first filter's run over the second episode."""
    checkpoint = load_checkpoint(Path(str(base_settings.checkpoints["crossmodal-ekf"])))
    with open_dataset(base_settings.data["mine"], DOOR) as data:
        run = trace(checkpoint, data[1], episode_index=1, seed=0, particles=base_settings.particles)
    return write_recording(run, tmp_path_factory.mktemp("own") / "run.rrd").read_bytes()


@pytest.fixture(scope="session")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Another application's recording."""
    path = tmp_path_factory.mktemp("foreign") / "foreign.rrd"
    with rr.RecordingStream("their_app") as stream:
        stream.save(path)
        stream.log("world/points", rr.Points3D([[0, 0, 0]]))
        stream.flush()
        stream.disconnect()
    return path.read_bytes()


@pytest.fixture
def folder(settings: Settings) -> Path:
    """The server's folder of recordings."""
    path = settings.workspace / "recordings"
    path.mkdir(parents=True)
    return path


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files in this process, which has imported Rerun, instead of a subprocess."""

    def read(self: RecordingProbe, path: Path) -> RecordingInfo:
        try:
            return RecordingInfo.from_json(describe(path), path)
        except BadInput as error:
            return RecordingInfo.from_json({"error": str(error)}, path)

    monkeypatch.setattr(RecordingProbe, "__call__", read)


IN_PROCESS = pytest.mark.usefixtures("in_process")


def listed(client: TestClient) -> dict[str, dict[str, Any]]:
    """The recordings by name, once all have been read."""
    end = time.monotonic() + TIMEOUT
    while True:
        recordings = client.get(URL).json()["recordings"]
        if not any(r["reading"] for r in recordings):
            return {r["name"]: r for r in recordings}
        assert time.monotonic() < end
        time.sleep(0.05)


def test_write_list_and_download(client: TestClient, trace_url: str, settings: Settings) -> None:
    body = {"task": "door", "filter": "crossmodal-pf", "episode": 1, "faults": ""}
    answer = client.post("/api/recordings", json=body)
    assert answer.status_code == 201, answer.text
    written = answer.json()
    assert written["name"].startswith("door-crossmodal-pf-episode1-")
    (entry,) = client.get("/api/recordings").json()["recordings"]
    assert (entry["name"], entry["bytes"]) == (written["name"], written["bytes"])
    assert (entry["task"], entry["filter"], entry["episode"]) == ("door", "crossmodal-pf", 1)
    content = client.get(written["url"]).content
    assert content == (settings.workspace / "recordings" / written["name"]).read_bytes()
    part = client.get(written["url"], headers={"Range": "bytes=4-11"})
    assert (part.status_code, part.content) == (206, content[4:12])
    run = read_recording(settings.workspace / "recordings" / written["name"])
    (offset,) = (c["offset"] for c in client.get(trace_url).json()["columns"] if c["name"] == "estimate_mean")
    estimate = np.frombuffer(client.get(f"{trace_url}/columns").content, "<f4", run.estimate_mean.size, offset)
    np.testing.assert_array_equal(run.estimate_mean.ravel(), estimate)


def test_threads_end_with_the_server(settings: Settings, open_client: Callable[..., Any]) -> None:
    with open_client(settings) as client:
        assert client.post(URL, json={"task": "door", "filter": "crossmodal-pf", "episode": 1}).status_code == 201
    assert not [thread for thread in threading.enumerate() if "recordings" in thread.name]


def test_existing_recording_is_not_written_again(client: TestClient, trace_url: str, settings: Settings) -> None:
    body = {"task": "door", "filter": "crossmodal-pf", "episode": 1}
    first = client.post("/api/recordings", json=body).json()
    path = settings.workspace / "recordings" / first["name"]
    before = path.stat().st_mtime_ns
    again = client.post("/api/recordings", json=body)
    assert (again.status_code, again.json()) == (200, first | {"seconds": None})
    assert path.stat().st_mtime_ns == before
    other = client.post("/api/recordings", json=body | {"faults": "blackout=0.5"})
    assert other.status_code == 201
    assert other.json()["name"] != first["name"]


def workspace_of(client: TestClient) -> Path:
    return client.app.state.store.settings.workspace  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "name", ["../traces/x", "..%2ftraces%2fx", "..%5cx", "%2fetc%2fpasswd", ".hidden", "door-crossmodal-pf-episode1-zz"]
)
def test_names_do_not_leave_the_folder(shared_client: TestClient, name: str) -> None:
    traces = workspace_of(shared_client) / "traces"
    traces.mkdir(parents=True, exist_ok=True)
    (traces / "x.rrd").write_bytes(b"secret")
    answer = shared_client.get(f"/api/recordings/{name}.rrd")
    assert answer.status_code == 404
    assert b"secret" not in answer.content


@pytest.mark.parametrize(
    ("body", "status", "message"),
    [
        (b"not json", 422, "JSON"),
        (b"{}", 422, "Field required"),
        (b'{"task": "door", "filter": "crossmodal-pf", "episode": "1"}', 422, "body.episode"),
        (b'{"task": "door", "filter": "crossmodal-pf", "episode": 1, "maps": -1}', 422, "body.maps"),
        (b'{"task": "door", "filter": "none", "episode": 1}', 400, "filter 'none' does not exist"),
    ],
)
def test_invalid_requests_write_nothing(shared_client: TestClient, body: bytes, status: int, message: str) -> None:
    answer = shared_client.post("/api/recordings", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == status
    assert message in answer.json()["error"]
    assert not (workspace_of(shared_client) / "recordings").exists()


def test_upload_reads_metadata(client: TestClient, run_recording: bytes, folder: Path) -> None:
    answer = client.put(f"{URL}/theirs%20(1).rrd", content=run_recording)
    assert answer.status_code == 201, answer.text
    assert (folder / "theirs (1).rrd").read_bytes() == run_recording
    (entry,) = listed(client).values()
    assert answer.json() == entry
    values = {key: entry[key] for key in ("name", "task", "filter", "episode", "steps", "faults", "problem", "why_not")}
    run = {"task": "door", "filter": "crossmodal-ekf", "episode": 1, "steps": 40, "faults": ""}
    assert values == run | {"name": "theirs (1).rrd", "problem": "", "why_not": ""}
    assert entry["run"] == {"filter": "crossmodal-ekf", "data": "mine"}
    assert client.get(entry["url"]).content == run_recording
    assert not [path for path in folder.iterdir() if path.name.endswith(".part")]


@IN_PROCESS
def test_recording_of_another_application(client: TestClient, foreign: bytes) -> None:
    entry = client.put(f"{URL}/foreign.rrd", content=foreign).json()
    assert (entry["application"], entry["task"], entry["run"]) == ("their_app", None, None)
    assert "Written by 'their_app', not by beliefscope" in entry["problem"]
    assert entry["entities"] >= 1


@IN_PROCESS
def test_reason_why_a_run_is_not_in_the_catalog(
    settings: Settings, open_client: Callable[..., TestClient], run_recording: bytes, folder: Path
) -> None:
    (folder / "run.rrd").write_bytes(run_recording)
    for changes, reason in (
        ({"checkpoints": {}}, "Filter crossmodal-ekf of door with checkpoint"),
        ({"data": {}}, "No data set of this server contains its episode 1"),
        ({"seed": 3}, "seed 0; this server uses seed 3"),
    ):
        with open_client(replace(settings, **changes)) as client:
            (entry,) = listed(client).values()
        assert entry["run"] is None
        assert reason in entry["why_not"]


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a complete Rerun recording"),
        (b"\x89PNG\r\n", "begin with RRF"),
        (b"RRF2" + bytes(8), "not a complete Rerun recording"),
        (b"RRF2\x00\x29\x00\x00\x01\x02\x00\x00" + bytes(range(256)) * 40, "not a complete Rerun recording"),
        (None, "not a complete Rerun recording"),
    ],
    ids=["empty", "image", "zeros", "junk", "truncated"],
)
def test_invalid_files_are_refused(
    client: TestClient, run_recording: bytes, folder: Path, content: bytes | None, message: str
) -> None:
    answer = client.put(
        f"{URL}/x.rrd", content=run_recording[: len(run_recording) // 2] if content is None else content
    )
    assert answer.status_code == 400
    assert message in answer.json()["error"]
    assert str(folder) not in answer.json()["error"]
    assert not list(folder.iterdir())
    assert not listed(client)


@IN_PROCESS
def test_an_upload_that_is_cancelled_while_it_is_examined_is_not_added(
    address: str, run_recording: bytes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    examined, cancelled = threading.Event(), threading.Event()

    def probe(self: RecordingProbe, path: Path) -> RecordingInfo:
        examined.set()
        assert cancelled.wait(20.0)
        return RecordingInfo(application="other")

    monkeypatch.setattr(RecordingProbe, "__call__", probe)
    connection = http.client.HTTPConnection(address)
    connection.request("PUT", f"{URL}/x.rrd", run_recording, {"Origin": f"http://{address}"})
    assert examined.wait(10.0)
    assert [path.suffix for path in folder.iterdir()] == [".part"]
    connection.close()
    deadline = time.monotonic() + 10.0
    while list(folder.iterdir()):  # before the file has been examined
        assert time.monotonic() < deadline, "the upload was not stopped"
        time.sleep(0.02)
    cancelled.set()
    with urlopen(f"http://{address}{URL}") as reply:
        assert json.load(reply)["recordings"] == []


def test_upload_size_is_limited(
    client: TestClient, run_recording: bytes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings, "MAX_UPLOAD", 10_000)
    chunks = (
        run_recording[start : start + 4000] for start in range(0, len(run_recording), 4000)
    )  # without content-length
    for content in (run_recording, chunks):
        answer = client.put(f"{URL}/x.rrd", content=content)
        assert answer.status_code == 413
        assert "larger than 0 MB" in answer.json()["error"]
    assert client.get(URL).json()["largest"] == 10_000
    assert not list(folder.iterdir())


def test_crash_of_the_reader(
    client: TestClient, run_recording: bytes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rerun 0.41 aborts on ``abort.rrd``, which has one flipped bit; ``/bin/false`` stands for any crash."""
    (folder / "bad.rrd").write_bytes((Path(__file__).parent / "abort.rrd").read_bytes())
    (entry,) = listed(client).values()
    assert entry["problem"]
    assert (entry["application"], entry["run"]) == ("", None)
    monkeypatch.setattr("sys.executable", "/bin/false")
    (folder / "bad.rrd").write_bytes(run_recording)
    (entry,) = listed(client).values()
    assert "Reading the file failed" in entry["problem"]
    answer = client.put(f"{URL}/x.rrd", content=run_recording)
    assert answer.status_code == 400
    assert "Reading the file failed" in answer.json()["error"]


@IN_PROCESS
def test_rename(client: TestClient, run_recording: bytes) -> None:
    client.put(f"{URL}/a.rrd", content=run_recording)
    client.put(f"{URL}/b.rrd", content=run_recording)
    conflict = client.patch(f"{URL}/a.rrd", json={"name": "b"})
    assert (conflict.status_code, "'b.rrd' already exists" in conflict.json()["error"]) == (409, True)
    assert client.put(f"{URL}/b.rrd", content=run_recording).status_code == 409
    renamed = client.patch(f"{URL}/a.rrd", json={"name": "Tür (neu)"}).json()
    assert (renamed["name"], renamed["reading"], renamed["task"]) == ("Tür (neu).rrd", False, "door")
    assert client.get(renamed["url"]).content == run_recording
    assert client.get(f"{URL}/a.rrd").status_code == 404
    assert listed(client).keys() == {"Tür (neu).rrd", "b.rrd"}


@IN_PROCESS
def test_invalid_names_are_refused(client: TestClient, run_recording: bytes) -> None:
    before = client.put(f"{URL}/a.rrd", content=run_recording).json()
    names = ("", "..", "../x", "a\\b", ".hidden", "a" * 300)
    for body in (*({"name": name} for name in names), {"tag": 1}, [], None):
        answer = client.patch(f"{URL}/a.rrd", json=body)
        assert answer.status_code in (400, 422), body
        assert "\n" not in answer.json()["error"]
    assert list(listed(client).values()) == [before]


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a\0b", "a\nb", " a", "a ", "a.", "x" * 201, "ü" * 101, "a:b"])
def test_invalid_file_names(name: str) -> None:
    with pytest.raises(BadInput, match="Name"):
        checked(name)


@IN_PROCESS
def test_delete_and_restore(client: TestClient, run_recording: bytes, folder: Path) -> None:
    client.put(f"{URL}/a.rrd", content=run_recording)
    before = client.get(URL).json()["recordings"][0]
    id = client.delete(f"{URL}/a.rrd").json()["deleted"]
    lists = client.get(URL).json()
    assert lists["recordings"] == []
    assert [(d["id"], d["name"], d["bytes"]) for d in lists["deleted"]] == [(id, "a.rrd", len(run_recording))]
    client.put(f"{URL}/a.rrd", content=run_recording)
    assert client.post(f"{URL}/deleted/{id}").status_code == 409
    client.patch(f"{URL}/a.rrd", json={"name": "other"})
    assert client.post(f"{URL}/deleted/{id}").json()["name"] == "a.rrd"
    assert listed(client)["a.rrd"] == before
    assert client.post(f"{URL}/deleted/{id}").status_code == 404
    client.delete(f"{URL}/a.rrd")
    assert client.delete(f"{URL}/deleted").json() == {"freed": len(run_recording)}
    assert client.get(URL).json()["deleted"] == []
    assert not list((folder / ".deleted").iterdir())


@IN_PROCESS
def test_deleted_files_expire(
    client: TestClient, run_recording: bytes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "a.rrd").write_bytes(run_recording)
    client.delete(f"{URL}/a.rrd")
    assert len(client.get(URL).json()["deleted"]) == 1
    later = time.time() + 86400 * trash.RETENTION_DAYS + 1
    monkeypatch.setattr(trash.time, "time", lambda: later)
    assert client.get(URL).json()["deleted"] == []
    assert not list((folder / ".deleted").iterdir())


@IN_PROCESS
def test_a_file_that_another_program_deleted_does_not_exist(
    client: TestClient, run_recording: bytes, folder: Path
) -> None:
    client.put(f"{URL}/a.rrd", content=run_recording)
    (folder / "a.rrd").unlink()
    assert client.get(URL).json()["recordings"] == []
    for answer in (
        client.get(f"{URL}/a.rrd"),
        client.patch(f"{URL}/a.rrd", json={"name": "x"}),
        client.delete(f"{URL}/a.rrd"),
    ):
        assert answer.status_code == 404
        assert "does not exist" in answer.json()["error"]


@IN_PROCESS
def test_metadata_are_read_again_after_a_change(
    client: TestClient, run_recording: bytes, foreign: bytes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "a.rrd").write_bytes(run_recording)
    assert listed(client)["a.rrd"]["task"] == "door"
    metadata = folder / ".about" / "a.rrd.json"
    written = metadata.stat().st_mtime_ns
    assert listed(client)["a.rrd"]["task"] == "door"
    assert metadata.stat().st_mtime_ns == written
    (folder / "a.rrd").write_bytes(foreign)
    assert listed(client)["a.rrd"]["application"] == "their_app"
    metadata.write_text("{broken")
    assert listed(client)["a.rrd"]["application"] == "their_app"


def test_links_and_partial_files_are_not_listed(
    settings: Settings, open_client: Callable[..., TestClient], folder: Path, tmp_path: Path
) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(b"secret")
    (folder / "link.rrd").symlink_to(secret)
    (folder / "folder.rrd").mkdir()
    (folder / ".new.part").write_bytes(b"half")
    with open_client(settings) as client:
        assert listed(client) == {}
        for name in ("link", "folder", ".new"):
            assert client.get(f"{URL}/{name}.rrd").status_code == 404
            assert client.delete(f"{URL}/{name}.rrd").status_code == 404
        assert client.put(f"{URL}/link.rrd", content=b"RRF2").status_code == 409
    assert secret.read_bytes() == b"secret"

"""The store of recordings over HTTP: written, added, named, tagged, deleted and had back."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from starlette.testclient import TestClient

from beliefscope.app.api import recordings
from beliefscope.app.runs.settings import Settings
from beliefscope.app.workspace import trash
from beliefscope.app.workspace.recording_probe import RecordingInfo, RecordingProbe
from beliefscope.app.workspace.recordings import checked
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.inspect.trace import trace
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.rerun_log.metadata import describe
from beliefscope.recordings.write import write_recording

URL = "/api/recordings"
PATIENCE = 60.0  # s: a file is read by a process that imports Rerun first


@pytest.fixture(scope="session")
def own(base_settings: Settings, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording of the first filter's run over the second given episode, made elsewhere."""
    checkpoint = load_checkpoint(Path(str(base_settings.checkpoints["crossmodal-ekf"])))
    with open_dataset(base_settings.data["mine"], DOOR) as data:
        run = trace(checkpoint, data[1], episode_index=1, seed=0, particles=base_settings.particles)
    return write_recording(run, tmp_path_factory.mktemp("own") / "run.rrd").read_bytes()


@pytest.fixture(scope="session")
def strange(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Another application's recording."""
    path = tmp_path_factory.mktemp("strange") / "strange.rrd"
    with rr.RecordingStream("their_app") as stream:
        stream.save(path)
        stream.log("world/points", rr.Points3D([[0, 0, 0]]))
        stream.flush()
        stream.disconnect()
    return path.read_bytes()


@pytest.fixture
def folder(settings: Settings) -> Path:
    """Where the recordings of the server lie, and those that a user copies there."""
    made = settings.workspace / "recordings"
    made.mkdir(parents=True)
    return made


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are read by the same function in this process, which has imported Rerun already."""

    def read(self: RecordingProbe, path: Path) -> RecordingInfo:
        try:
            return RecordingInfo.from_json(describe(path), path)
        except BadInput as error:
            return RecordingInfo.from_json({"error": str(error)}, path)

    monkeypatch.setattr(RecordingProbe, "__call__", read)


HERE = pytest.mark.usefixtures("here")


def listed(client: TestClient) -> dict[str, dict[str, Any]]:
    """The recordings by name, once all of them are known."""
    end = time.monotonic() + PATIENCE
    while True:
        found = client.get(URL).json()["recordings"]
        if not any(one["reading"] for one in found):
            return {one["name"]: one for one in found}
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_recording_is_written_listed_and_read(client: TestClient, trace_url: str, settings: Settings) -> None:
    wanted = {"task": "door", "filter": "crossmodal-pf", "episode": 1, "faults": ""}
    answer = client.post("/api/recordings", json=wanted)
    assert answer.status_code == 201, answer.text
    made = answer.json()
    assert made["name"].startswith("door-crossmodal-pf-episode1-")
    (listed,) = client.get("/api/recordings").json()["recordings"]
    assert (listed["name"], listed["bytes"]) == (made["name"], made["bytes"])
    assert (listed["task"], listed["filter"], listed["episode"]) == ("door", "crossmodal-pf", 1)
    content = client.get(made["url"]).content
    assert content == (settings.workspace / "recordings" / made["name"]).read_bytes()
    part = client.get(made["url"], headers={"Range": "bytes=4-11"})
    assert (part.status_code, part.content) == (206, content[4:12])
    run = read_recording(settings.workspace / "recordings" / made["name"])
    (offset,) = (c["offset"] for c in client.get(trace_url).json()["columns"] if c["name"] == "estimate_mean")
    shown = np.frombuffer(client.get(f"{trace_url}/columns").content, "<f4", run.estimate_mean.size, offset)
    np.testing.assert_array_equal(run.estimate_mean.ravel(), shown)


def test_nothing_of_it_is_left_when_the_server_has_ended(settings: Settings, open_client: Callable[..., Any]) -> None:
    with open_client(settings) as client:
        assert client.post(URL, json={"task": "door", "filter": "crossmodal-pf", "episode": 1}).status_code == 201
    assert not [one for one in threading.enumerate() if "recordings" in one.name]


def test_a_recording_that_is_there_is_not_written_again(client: TestClient, trace_url: str, settings: Settings) -> None:
    wanted = {"task": "door", "filter": "crossmodal-pf", "episode": 1}
    first = client.post("/api/recordings", json=wanted).json()
    path = settings.workspace / "recordings" / first["name"]
    before = path.stat().st_mtime_ns
    again = client.post("/api/recordings", json=wanted)
    assert (again.status_code, again.json()) == (200, first | {"seconds": None})
    assert path.stat().st_mtime_ns == before
    other = client.post("/api/recordings", json=wanted | {"faults": "blackout=0.5"})
    assert other.status_code == 201
    assert other.json()["name"] != first["name"]


@pytest.mark.parametrize(
    "name", ["../traces/x", "..%2ftraces%2fx", "..%5cx", "%2fetc%2fpasswd", ".hidden", "door-crossmodal-pf-episode1-zz"]
)
def test_a_recordings_name_leads_nowhere_else(client: TestClient, settings: Settings, name: str) -> None:
    (settings.workspace / "traces").mkdir(parents=True)
    (settings.workspace / "traces" / "x.rrd").write_bytes(b"secret")
    answer = client.get(f"/api/recordings/{name}.rrd")
    assert answer.status_code == 404
    assert b"secret" not in answer.content


@pytest.mark.parametrize(
    ("body", "status", "said"),
    [
        (b"not json", 422, "JSON"),
        (b"{}", 422, "Field required"),
        (b'{"task": "door", "filter": "crossmodal-pf", "episode": "1"}', 422, "body.episode"),
        (b'{"task": "door", "filter": "crossmodal-pf", "episode": 1, "maps": -1}', 422, "body.maps"),
        (b'{"task": "door", "filter": "none", "episode": 1}', 400, "filter 'none' does not exist"),
    ],
)
def test_a_bad_request_for_a_recording_writes_nothing(
    client: TestClient, settings: Settings, body: bytes, status: int, said: str
) -> None:
    answer = client.post("/api/recordings", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == status
    assert said in answer.json()["error"]
    assert not (settings.workspace / "recordings").exists()


def test_a_file_of_ours_is_added_with_all_that_it_says(client: TestClient, own: bytes, folder: Path) -> None:
    answer = client.put(f"{URL}/theirs%20(1).rrd", content=own)
    assert answer.status_code == 201, answer.text
    assert (folder / "theirs (1).rrd").read_bytes() == own
    (found,) = listed(client).values()
    assert answer.json() == found
    said = {key: found[key] for key in ("name", "task", "filter", "episode", "steps", "faults", "problem", "why_not")}
    assert said == {
        "name": "theirs (1).rrd",
        "task": "door",
        "filter": "crossmodal-ekf",
        "episode": 1,
        "steps": 40,
        "faults": "",
        "problem": "",
        "why_not": "",
    }
    assert found["run"] == {"filter": "crossmodal-ekf", "data": "mine"}
    assert client.get(found["url"]).content == own
    assert not [path for path in folder.iterdir() if path.name.endswith(".part")]


@HERE
def test_a_strangers_file_is_listed_and_says_why_it_is_no_run(client: TestClient, strange: bytes) -> None:
    found = client.put(f"{URL}/strange.rrd", content=strange).json()
    assert (found["application"], found["task"], found["run"]) == ("their_app", None, None)
    assert "written by 'their_app', not by beliefscope" in found["problem"]
    assert found["entities"] >= 1


@HERE
def test_what_the_server_has_not_is_said(
    settings: Settings, open_client: Callable[..., TestClient], own: bytes, folder: Path
) -> None:
    (folder / "run.rrd").write_bytes(own)
    for other, why in (
        ({"checkpoints": {}}, "Its filter, crossmodal-ekf of door with checkpoint"),
        ({"data": {}}, "No data set of this server has its episode 1"),
        ({"seed": 3}, "seed 0; this server runs filters with seed 3"),
    ):
        with open_client(replace(settings, **other)) as client:
            (found,) = listed(client).values()
        assert found["run"] is None
        assert why in found["why_not"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not a whole Rerun recording"),
        (b"\x89PNG\r\n", "begins with RRF"),
        (b"RRF2" + bytes(8), "not a whole Rerun recording"),
        (b"RRF2\x00\x29\x00\x00\x01\x02\x00\x00" + bytes(range(256)) * 40, "not a whole Rerun recording"),
        (None, "not a whole Rerun recording"),
    ],
    ids=["empty", "picture", "nothing", "junk", "cut"],
)
def test_what_is_no_recording_is_not_added(
    client: TestClient, own: bytes, folder: Path, content: bytes | None, said: str
) -> None:
    answer = client.put(f"{URL}/x.rrd", content=own[: len(own) // 2] if content is None else content)
    assert answer.status_code == 400
    assert said in answer.json()["error"]
    assert str(folder) not in answer.json()["error"]
    assert not list(folder.iterdir())
    assert not listed(client)


@HERE
def test_a_file_that_is_too_large_is_refused_before_and_while_it_comes(
    client: TestClient, own: bytes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings, "LARGEST", 10_000)
    blocks = (own[start : start + 4000] for start in range(0, len(own), 4000))  # without a length said before
    for content in (own, blocks):
        answer = client.put(f"{URL}/x.rrd", content=content)
        assert answer.status_code == 413
        assert "more than 0 MB" in answer.json()["error"]
    assert client.get(URL).json()["largest"] == 10_000
    assert not list(folder.iterdir())


def test_a_file_made_to_do_harm_ends_its_reader_only(
    client: TestClient, own: bytes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On one changed bit of ``abort.rrd`` Rerun 0.41 ends its process; one that always does stands for such readers."""
    (folder / "bad.rrd").write_bytes((Path(__file__).parent / "abort.rrd").read_bytes())
    (found,) = listed(client).values()
    assert found["problem"]
    assert (found["application"], found["run"]) == ("", None)
    monkeypatch.setattr("sys.executable", "/bin/false")
    (folder / "bad.rrd").write_bytes(own)
    (found,) = listed(client).values()
    assert "Reading the file failed" in found["problem"]
    answer = client.put(f"{URL}/x.rrd", content=own)
    assert answer.status_code == 400
    assert "Reading the file failed" in answer.json()["error"]


@HERE
def test_names_and_tags_change_and_outlive_the_server(
    settings: Settings, open_client: Callable[..., TestClient], own: bytes
) -> None:
    with open_client(settings) as client:
        client.put(f"{URL}/a.rrd", content=own)
        client.put(f"{URL}/b.rrd", content=own)
        answer = client.patch(f"{URL}/a.rrd", json={"tags": ["paper", "Fig  3", "PAPER"]})
        assert answer.json()["tags"] == ["paper", "Fig 3"]
        taken = client.patch(f"{URL}/a.rrd", json={"name": "b"})
        assert (taken.status_code, "'b.rrd' already exists" in taken.json()["error"]) == (409, True)
        assert client.put(f"{URL}/b.rrd", content=own).status_code == 409
        renamed = client.patch(f"{URL}/a.rrd", json={"name": "Tür (neu)"}).json()
        assert (renamed["name"], renamed["tags"]) == ("Tür (neu).rrd", ["paper", "Fig 3"])
        assert client.get(renamed["url"]).content == own
        assert client.get(f"{URL}/a.rrd").status_code == 404
    with open_client(settings) as client:
        assert {name: one["tags"] for name, one in listed(client).items()} == {
            "Tür (neu).rrd": ["paper", "Fig 3"],
            "b.rrd": [],
        }


@HERE
def test_what_cannot_be_a_name_or_tag_changes_nothing(client: TestClient, own: bytes) -> None:
    before = client.put(f"{URL}/a.rrd", content=own).json()
    names = ("", "..", "../x", "a\\b", ".hidden", "a" * 300)
    tags = ([""], ["a,b"], ["x" * 41], [f"{i}" for i in range(30)], "x")
    for body in (*({"name": name} for name in names), *({"tags": some} for some in tags), {"tag": 1}, [], None):
        answer = client.patch(f"{URL}/a.rrd", json=body)
        assert answer.status_code in (400, 422), body
        assert "\n" not in answer.json()["error"]
    assert list(listed(client).values()) == [before]


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a\0b", "a\nb", " a", "a ", "a.", "x" * 201, "ü" * 101, "a:b"])
def test_no_name_leads_out_of_its_folder(name: str) -> None:
    with pytest.raises(BadInput, match="Name"):
        checked(name)


@HERE
def test_what_was_deleted_is_had_back(client: TestClient, own: bytes, folder: Path) -> None:
    client.put(f"{URL}/a.rrd", content=own)
    before = client.patch(f"{URL}/a.rrd", json={"tags": ["kept"]}).json()
    id = client.delete(f"{URL}/a.rrd").json()["deleted"]
    now = client.get(URL).json()
    assert now["recordings"] == []
    assert [(one["id"], one["name"], one["bytes"]) for one in now["deleted"]] == [(id, "a.rrd", len(own))]
    client.put(f"{URL}/a.rrd", content=own)
    assert client.post(f"{URL}/deleted/{id}").status_code == 409
    client.patch(f"{URL}/a.rrd", json={"name": "other"})
    assert client.post(f"{URL}/deleted/{id}").json() == before
    assert client.post(f"{URL}/deleted/{id}").status_code == 404
    client.delete(f"{URL}/a.rrd")
    assert client.delete(f"{URL}/deleted").json() == {"freed": len(own)}
    assert client.get(URL).json()["deleted"] == []
    assert not list((folder / ".deleted").iterdir())


@HERE
def test_the_trash_lets_go_after_its_days(
    client: TestClient, own: bytes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "a.rrd").write_bytes(own)
    client.delete(f"{URL}/a.rrd")
    assert len(client.get(URL).json()["deleted"]) == 1
    later = time.time() + 86400 * trash.DAYS + 1
    monkeypatch.setattr(trash.time, "time", lambda: later)
    assert client.get(URL).json()["deleted"] == []
    assert not list((folder / ".deleted").iterdir())


@HERE
def test_a_list_is_told_again_only_when_it_has_changed(client: TestClient, own: bytes, folder: Path) -> None:
    client.put(f"{URL}/a.rrd", content=own)
    tag = client.get(URL).headers["etag"]
    assert client.get(URL, headers={"If-None-Match": tag}).status_code == 304
    (folder / "a.rrd").unlink()  # under the server
    assert client.get(URL, headers={"If-None-Match": tag}).json()["recordings"] == []
    for answer in (
        client.get(f"{URL}/a.rrd"),
        client.patch(f"{URL}/a.rrd", json={"tags": ["x"]}),
        client.delete(f"{URL}/a.rrd"),
    ):
        assert answer.status_code == 404
        assert "does not exist" in answer.json()["error"]


@HERE
def test_a_file_is_read_once_and_again_when_it_is_another(
    client: TestClient, own: bytes, strange: bytes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "a.rrd").write_bytes(own)
    client.patch(f"{URL}/a.rrd", json={"tags": ["x"]})
    assert listed(client)["a.rrd"]["task"] == "door"
    lines = folder / ".about" / "a.rrd.json"
    written = lines.stat().st_mtime_ns
    assert listed(client)["a.rrd"]["task"] == "door"
    assert lines.stat().st_mtime_ns == written
    (folder / "a.rrd").write_bytes(strange)
    found = listed(client)["a.rrd"]
    assert (found["application"], found["tags"]) == ("their_app", ["x"])
    lines.write_text("{broken")
    assert listed(client)["a.rrd"]["application"] == "their_app"


def test_links_and_files_under_way_are_no_recordings(
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


@HERE
def test_a_renamed_recording_is_not_written_again_and_a_namesake_is_not_taken_for_it(
    client: TestClient, trace_url: str, own: bytes, folder: Path
) -> None:
    wanted = {"task": "door", "filter": "crossmodal-pf", "episode": 1}
    made = client.post(URL, json=wanted).json()
    client.patch(f"{URL}/{made['name']}", json={"name": "mine"})
    again = client.post(URL, json=wanted)
    assert (again.status_code, again.json()["name"]) == (200, "mine.rrd")
    client.delete(f"{URL}/mine.rrd")
    client.put(f"{URL}/{made['name']}", content=own)  # under the name that the page would give
    other = client.post(URL, json=wanted)
    assert (other.status_code, other.json()["name"]) == (201, made["name"].replace(".rrd", "-2.rrd"))
    assert read_recording(folder / other.json()["name"]).filter == "crossmodal-pf"
    assert json.loads((folder / ".about" / f"{other.json()['name']}.json").read_text())["original_name"] == made["name"]

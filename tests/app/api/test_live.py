"""Live runs over HTTP: every page gets every step, at its own speed; a dead or damaged run is told."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient, WebSocketTestSession

from beliefscope.app.api.live import PATIENCE
from beliefscope.app.protocol.trace_format import camera_images, columns
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.failures.events import failures_of
from beliefscope.inspect.failures.step_scores import Survey
from beliefscope.inspect.trace import Trace, arrays_of, header_of, trace, trace_from_arrays
from beliefscope.inspect.traces.live_file import LiveFileReader, LiveFileWriter
from beliefscope.recordings.read import read_recording

STEPS = 24
SHOWN = "/api/trace/door/{}/9?data=live:run"


def cut(whole: Trace, first: int, last: int) -> Trace:
    static = ("start_mean", "start_covariance")
    return trace_from_arrays(header_of(whole), {n: a if n in static else a[first:last] for n, a in arrays_of(whole).items()})


@pytest.fixture(scope="module", params=["crossmodal-ekf", "crossmodal-pf"])
def whole(request: pytest.FixtureRequest) -> Trace:
    checkpoint = load_checkpoint(shipped("door", request.param))
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    short = {one: getattr(episode, one)[:STEPS] for one in ("states", "controls", "contact", "qpos")}
    seen = {key: array[:STEPS] for key, array in episode.observations.items()}
    return trace(checkpoint, replace(episode, **short, observations=seen), 9, seed=0, particles=40)


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """What ships."""
    return Settings(tmp_path / "workspace")


@pytest.fixture
def folder(settings: Any) -> Path:
    made: Path = settings.workspace / "live"
    made.mkdir(parents=True)
    return made


@pytest.fixture
def writer(folder: Path, whole: Trace) -> Iterator[LiveFileWriter]:
    made = LiveFileWriter(folder / "run.live", whole, expected=STEPS)
    yield made
    made.close()


def ask(socket: WebSocketTestSession, first: int, state: str = "running") -> tuple[dict[str, Any], bytes]:
    socket.send_text(json.dumps({"from": first, "state": state}))
    message = socket.receive_bytes()
    length = int.from_bytes(message[:4], "little")
    return json.loads(message[4 : 4 + length]), message[4 + length + -length % 4 :]


def values(head: dict[str, Any], buffer: bytes) -> dict[str, np.ndarray[Any, Any]]:
    found = {}
    for column in head["columns"]:
        count = int(np.prod(column["shape"]))
        found[column["name"]] = np.frombuffer(buffer, "<f4", count, column["offset"]).reshape(column["shape"])
    seen = np.frombuffer(buffer[len(buffer) - head["pictures"] :], np.uint8)
    return found | {"pictures": seen.reshape(head["steps"], 32, 32)}


def expected(whole: Trace) -> dict[str, np.ndarray[Any, Any]]:
    said, buffer = columns(whole)
    shown = camera_images(whole)
    assert shown is not None
    return values({"columns": said, "pictures": shown.nbytes, "steps": len(whole)}, buffer + shown.tobytes())


def same(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_allclose(one[name], other[name], rtol=1e-5, atol=1e-7, err_msg=name)


def test_pages_of_different_speeds_both_get_everything(client: TestClient, writer: LiveFileWriter, whole: Trace) -> None:
    """One asks after each step that is written, the other once in a while: its blocks are larger, nothing is lost."""
    got: dict[str, list[Any]] = {"fast": [], "slow": []}
    with client.websocket_connect("/api/live/run") as fast, client.websocket_connect("/api/live/run") as slow:
        for step in range(STEPS):
            writer.append(cut(whole, step, step + 1))
            head, buffer = ask(fast, step)
            assert (head["first"], head["steps"], head["total"], head["state"]) == (step, 1, step + 1, "running")
            got["fast"].append(values(head, buffer))
            if step % 8 == 7:
                head, buffer = ask(slow, step - 7)
                assert head["steps"] == 8
                got["slow"].append(values(head, buffer))
        writer.finish()
        head, _ = ask(fast, STEPS)
        assert (head["steps"], head["state"], head["message"]) == (0, "ended", "")
    for blocks in got.values():
        same({name: np.concatenate([b[name] for b in blocks]) for name in blocks[0]}, expected(whole))


def test_a_page_that_does_not_ask_costs_nothing(address: str, settings: Any, whole: Trace) -> None:
    """The server sends only what is asked for: nothing waits in it for a page that has stalled."""
    from websockets.sync.client import connect

    folder = settings.workspace / "live"
    folder.mkdir(parents=True)
    writer = LiveFileWriter(folder / "run.live", whole)
    with connect(f"ws://{address}/api/live/run", origin=f"http://{address}", max_size=None) as socket:  # type: ignore[arg-type]
        for _ in range(20):
            writer.append(whole)
        with pytest.raises(TimeoutError):
            socket.recv(timeout=0.2)
        socket.send(json.dumps({"from": 0, "state": "running"}))
        message = socket.recv(timeout=10)
        assert len(message) < (1 << 22)
        with pytest.raises(TimeoutError):
            socket.recv(timeout=0.2)
    writer.close()


def test_one_message_is_bounded(client: TestClient, writer: LiveFileWriter, whole: Trace, monkeypatch: Any) -> None:
    """However long the run: the page asks again for the rest."""
    writer.append(whole)
    monkeypatch.setattr("beliefscope.app.api.live.BLOCK", 5 * writer_row(writer))
    first, parts = 0, []
    with client.websocket_connect("/api/live/run") as socket:
        while first < STEPS:
            head, buffer = ask(socket, first)
            assert 0 < head["steps"] <= 5
            parts.append(values(head, buffer))
            first += head["steps"]
    same({name: np.concatenate([p[name] for p in parts]) for name in parts[0]}, expected(whole))


def writer_row(writer: LiveFileWriter) -> int:
    reader = LiveFileReader(writer.path)
    reader.close()
    return reader.bytes_per_step


def test_a_page_waits_until_a_step_comes(client: TestClient, writer: LiveFileWriter, whole: Trace) -> None:
    writer.append(cut(whole, 0, 1))
    with client.websocket_connect("/api/live/run") as socket:
        late = threading.Timer(0.3, writer.append, [cut(whole, 1, 2)])
        late.start()
        head, _ = ask(socket, 1)
        assert head["steps"] == 1
        late.join()
        started = time.monotonic()
        head, _ = ask(socket, 2)
        assert head["steps"] == 0
        assert time.monotonic() - started >= PATIENCE - 0.1


def test_a_growing_run_is_shown_as_far_as_it_is(client: TestClient, writer: LiveFileWriter, whole: Trace) -> None:
    url = SHOWN.format(whole.filter)
    assert client.get(url).status_code == 202  # there is no step yet
    writer.append(cut(whole, 0, 10))
    header = client.get(url).json()
    assert (header["steps"], header["live"]["state"], header["live"]["expected"]) == (10, "running", STEPS)
    assert header["no_maps"] is None
    assert header["modalities"] == list(whole.modalities)
    writer.append(cut(whole, 10, STEPS))
    writer.finish()
    header = client.get(url).json()
    assert header["steps"] == STEPS
    assert "live" not in header  # an ordinary run from now on
    content = client.get(f"/api/trace/door/{whole.filter}/9/columns?data=live:run").content
    same(
        values({"columns": header["columns"], "pictures": 0, "steps": 0}, content),
        {**expected(whole), "pictures": np.zeros((0, 32, 32))},
    )


def test_maps_of_a_growing_run_are_those_of_the_whole(client: TestClient, writer: LiveFileWriter, whole: Trace) -> None:
    """Made of one step alone, as the newest must be; the same once it has ended."""
    writer.append(cut(whole, 0, 12))
    store = client.app.state.store  # type: ignore[attr-defined]
    asked = Selection("door", whole.filter, 9, data="live:run")
    growing = store.request(asked)
    assert growing.growing
    maps = [growing.map(step, None, 41) for step in (0, 11)]
    writer.append(cut(whole, 12, STEPS))
    writer.finish()
    ended = store.request(asked)
    assert not ended.growing
    for one in maps:
        np.testing.assert_allclose(
            one.log_likelihood, ended.map(one.step, None, 41).log_likelihood, rtol=1e-4, atol=1e-3
        )


def test_the_list_tells_how_each_run_is(client: TestClient, writer: LiveFileWriter, whole: Trace, folder: Path) -> None:
    """One goes on, one was killed at its step 4, one is no run at all; none keeps the others from being listed."""
    writer.append(cut(whole, 0, 3))
    dead = LiveFileWriter(folder / "dead.live", whole)
    dead.append(cut(whole, 0, 5))
    dead.close()
    (folder / "torn.live").write_bytes(b"BsL\nnot a run")
    for age, name in enumerate(("run", "dead", "torn")):
        os.utime(folder / f"{name}.live", (1e9 - age, 1e9 - age))
    listed = client.get("/api/live").json()["runs"]
    assert [(run["name"], run["state"]) for run in listed] == [
        ("run", "running"),
        ("dead", "died"),
        ("torn", "damaged"),
    ]
    assert (listed[0]["filter"], listed[0]["steps"], listed[0]["available"]) == (whole.filter, 3, True)
    assert listed[1]["message"] == "Live run 'dead' stopped at step 4: its process has exited without closing the file."
    assert "torn.live" in listed[2]["message"]
    assert client.get(SHOWN.format(whole.filter).replace("run", "dead")).json()["steps"] == 5


def test_a_filter_that_is_not_here_is_shown_without_its_networks(
    client: TestClient, folder: Path, whole: Trace
) -> None:
    """Another hash: its Gaussians are drawn; a particle filter's networks cannot be asked."""
    other = replace(whole, checkpoint_hash="f" * 64)
    writer = LiveFileWriter(folder / "run.live", other)
    writer.append(other)
    run = client.get("/api/live").json()["runs"][0]
    assert (run["filter"], run["available"]) == (f"{whole.filter} (live)", False)
    header = client.get(SHOWN.format(run["filter"])).json()
    assert (header["no_maps"] is None) == (whole.kind == "ekf")
    writer.finish()
    assert client.get(SHOWN.format(run["filter"])).json()["no_maps"] == header["no_maps"]
    writer.close()


def test_a_run_whose_truth_is_not_known(client: TestClient, folder: Path, whole: Trace) -> None:
    """Numbers of the truth are NaN and maps lie around the estimate; nothing fails."""
    blind = replace(whole, episode=replace(whole.episode, states=np.full_like(whole.episode.states, np.nan)))
    writer = LiveFileWriter(folder / "run.live", blind)
    writer.append(blind)
    with client.websocket_connect("/api/live/run") as socket:
        found = values(*ask(socket, 0))
    assert np.isnan(found["truth"]).all()
    assert np.isnan(found["nees"]).all()
    view = client.post("/api/views", json={}).json()
    with client.websocket_connect(view["socket"]) as socket:
        for serial, finish in enumerate((False, True)):
            if finish:
                writer.finish()
            cursor = {"type": "cursor", "serial": serial, "task": "door", "filter": whole.filter, "episode": 9}
            socket.send_json(cursor | {"step": STEPS - 1, "angle": None, "size": 41, "data": "live:run"})
            message = socket.receive_bytes()
            head = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
            assert head["truth"] == [None, None, None]
            assert head["numbers"]["truth"] == [None] * len(head["layers"])
            np.testing.assert_allclose(head["centre"], whole.estimate_mean[-1, :2], rtol=1e-5)
            assert socket.receive_json() == {"type": "drawn", "serial": serial, "step": STEPS - 1}
    writer.close()
    found = client.get(f"/api/failures/door/{whole.filter}?data=live:run").json()
    assert [score["total"] for score in found["scores"] if score["name"] == "error"] == [0]


def test_what_cannot_be_asked_of_a_live_run(client: TestClient, writer: LiveFileWriter, whole: Trace) -> None:
    writer.append(cut(whole, 0, 6))
    for url, said in {
        "/api/trace/door/image-ekf/9?data=live:run": "live run 'run' goes on",
        "/api/trace/push/crossmodal-ekf/9?data=live:run": "is of task 'door', episode 9",
        "/api/trace/door/crossmodal-ekf/9?data=live:none": "live run 'none' does not exist",
        "/api/trace/door/crossmodal-ekf/9?data=live:../secret": "does not exist",
        "/api/failures/door/crossmodal-ekf?data=live:run": "live run 'run' goes on",
    }.items():
        answer = client.get(url)
        assert (answer.status_code, said in answer.json()["error"]) == (400, True), answer.text
    with client.websocket_connect("/api/live/run") as socket:
        socket.send_text('{"from": -1}')
        assert socket.receive()["code"] == 4000


def test_another_filter_runs_over_a_run_that_has_ended(client: TestClient, writer: LiveFileWriter, whole: Trace) -> None:
    writer.append(whole)
    writer.finish()
    url = "/api/trace/door/image-ekf/9?data=live:run"
    deadline = time.monotonic() + 30.0
    while (answer := client.get(url)).status_code == 202:
        assert time.monotonic() < deadline
    assert answer.json()["steps"] == STEPS


def test_failures_of_a_run_that_has_ended_are_those_of_its_episode(
    client: TestClient, writer: LiveFileWriter, whole: Trace
) -> None:
    writer.append(whole)
    writer.finish()
    found = client.get(f"/api/failures/door/{whole.filter}?data=live:run").json()
    assert (found["data"], found["steps"], found["faults"]) == ("live:run", STEPS, "")
    by_error = next(score for score in found["scores"] if score["name"] == "error")
    expected = failures_of(Survey.from_traces([whole]), "error").events
    assert [(m["step"], m["value"]) for m in by_error["events"]] == [(m.step, m.score) for m in expected]
    assert {m["episode"] for m in by_error["events"]} == {9}
    assert "data=live%3Arun" in by_error["events"][0]["link"]
    asked = client.post(f"/api/failures/door/{whole.filter}?data=live:run")
    assert "a single episode, not a data set" in asked.json()["error"]


def until(client: TestClient, url: str) -> dict[str, Any]:
    deadline = time.monotonic() + 60.0
    while (answer := client.get(url)).status_code == 202:
        assert time.monotonic() < deadline
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_recorded_compared_and_diagnosed_as_any_run(
    client: TestClient, writer: LiveFileWriter, whole: Trace, settings: Any
) -> None:
    """A recording is of what there is by then; what needs the whole episode comes with its end."""
    asked = {"task": "door", "filter": whole.filter, "episode": 9, "data": "live:run", "maps": 4}
    written = []
    for first, last in ((0, 10), (10, STEPS)):
        writer.append(cut(whole, first, last))
        answer = client.post("/api/recordings", json=asked)
        assert answer.status_code == 201, answer.text
        written.append(read_recording(settings.workspace / "recordings" / answer.json()["name"]))
    assert [len(one) for one in written] == [10, STEPS]
    np.testing.assert_array_equal(written[1].estimate_mean, whole.estimate_mean)
    writer.finish()
    path = f"door/{whole.filter}/9"
    found = until(client, f"/api/compare/{path}?data=live:run&against=filter%3Dimage-ekf")
    assert found["names"] == [whole.filter, "image-ekf"]
    entries = {entry["name"]: entry for entry in client.get(f"/api/diagnostics/{path}?data=live:run").json()}
    name = next(name for name, entry in entries.items() if not entry["slow"] and not entry["why_not"])
    assert until(client, f"/api/diagnostics/{name}/{path}?data=live:run")["trajectories"] == 1


def test_its_recording_is_sent_as_it_grows(client: TestClient, writer: LiveFileWriter, whole: Trace) -> None:
    """Whole, though it grows while it is read; until the run has ended, not until the file has."""
    writer.append(cut(whole, 0, 1))
    recording = writer.path.with_suffix(".rrd")
    parts = [bytes([i]) * 300_000 for i in range(3)]

    def grow() -> None:
        for part in parts:
            time.sleep(0.15)
            with recording.open("ab") as file:
                file.write(part)
        time.sleep(0.15)
        writer.finish()

    growing = threading.Thread(target=grow)
    growing.start()
    assert client.get("/api/live/run.rrd").content == b"".join(parts)
    growing.join()
    recording.unlink()
    assert client.get("/api/live/run.rrd").status_code == 404

"""Live runs over HTTP: blocks of steps, states, and use as data sets."""

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

from beliefscope.app.api.live import TIMEOUT
from beliefscope.app.protocol.trace_format import columns
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.failures.events import failures_of
from beliefscope.inspect.failures.step_scores import EpisodeScores, Survey
from beliefscope.inspect.trace import Trace, arrays_of, header_of, trace, trace_from_arrays
from beliefscope.inspect.traces.live_file import LiveFileReader, LiveFileWriter
from beliefscope.inspect.traces.sensors import camera_images
from beliefscope.recordings.read import read_recording

pytestmark = pytest.mark.slow

STEPS = 24
TRACE = "/api/trace/door/{}/9?data=live:run"


def part(run: Trace, first: int, last: int) -> Trace:
    static = ("start_mean", "start_covariance")
    return trace_from_arrays(
        header_of(run), {n: a if n in static else a[first:last] for n, a in arrays_of(run).items()}
    )


@pytest.fixture(scope="module", params=[pytest.param("crossmodal-ekf", marks=pytest.mark.long), "crossmodal-pf"])
def full_trace(request: pytest.FixtureRequest) -> Trace:
    checkpoint = load_checkpoint(pretrained_path("door", request.param))
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    fields = {name: getattr(episode, name)[:STEPS] for name in ("states", "controls", "contact", "qpos")}
    observations = {key: array[:STEPS] for key, array in episode.observations.items()}
    return trace(checkpoint, replace(episode, **fields, observations=observations), 9, seed=0, particles=40)


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """Pretrained filters and sample data."""
    return Settings(tmp_path / "workspace")


@pytest.fixture
def folder(settings: Any) -> Path:
    path: Path = settings.workspace / "live"
    path.mkdir(parents=True)
    return path


@pytest.fixture
def writer(folder: Path, full_trace: Trace) -> Iterator[LiveFileWriter]:
    writer = LiveFileWriter(folder / "run.live", full_trace, expected=STEPS)
    yield writer
    writer.close()


def request_block(socket: WebSocketTestSession, first: int, state: str = "running") -> tuple[dict[str, Any], bytes]:
    socket.send_text(json.dumps({"from": first, "state": state}))
    message = socket.receive_bytes()
    length = int.from_bytes(message[:4], "little")
    return json.loads(message[4 : 4 + length]), message[4 + length + -length % 4 :]


def values(head: dict[str, Any], buffer: bytes) -> dict[str, np.ndarray[Any, Any]]:
    arrays = {}
    for column in head["columns"]:
        count = int(np.prod(column["shape"]))
        arrays[column["name"]] = np.frombuffer(buffer, "<f4", count, column["offset"]).reshape(column["shape"])
    images = np.frombuffer(buffer[len(buffer) - head["image_bytes"] :], np.uint8)
    return arrays | {"images": images.reshape(head["steps"], 32, 32)}


def expected(full_trace: Trace) -> dict[str, np.ndarray[Any, Any]]:
    descriptions, buffer = columns(full_trace)
    images = camera_images(full_trace)
    assert images is not None
    head = {"columns": descriptions, "image_bytes": images.nbytes, "steps": len(full_trace)}
    return values(head, buffer + images.tobytes())


def assert_equal(actual: dict[str, Any], expected: dict[str, Any]) -> None:
    assert actual.keys() == expected.keys()
    for name in actual:
        np.testing.assert_allclose(actual[name], expected[name], rtol=1e-5, atol=1e-7, err_msg=name)


def test_fast_and_slow_clients_receive_all_steps(client: TestClient, writer: LiveFileWriter, full_trace: Trace) -> None:
    """The slow client receives larger blocks."""
    blocks: dict[str, list[Any]] = {"fast": [], "slow": []}
    with client.websocket_connect("/api/live/run") as fast, client.websocket_connect("/api/live/run") as slow:
        for step in range(STEPS):
            writer.append(part(full_trace, step, step + 1))
            head, buffer = request_block(fast, step)
            assert (head["first"], head["steps"], head["total"], head["state"]) == (step, 1, step + 1, "running")
            blocks["fast"].append(values(head, buffer))
            if step % 8 == 7:
                head, buffer = request_block(slow, step - 7)
                assert head["steps"] == 8
                blocks["slow"].append(values(head, buffer))
        writer.finish()
        head, _ = request_block(fast, STEPS)
        assert (head["steps"], head["state"], head["message"]) == (0, "ended", "")
    for parts in blocks.values():
        assert_equal({name: np.concatenate([p[name] for p in parts]) for name in parts[0]}, expected(full_trace))


def test_nothing_is_sent_without_a_request(address: str, settings: Any, full_trace: Trace) -> None:
    from websockets.sync.client import connect

    folder = settings.workspace / "live"
    folder.mkdir(parents=True)
    writer = LiveFileWriter(folder / "run.live", full_trace)
    with connect(f"ws://{address}/api/live/run", origin=f"http://{address}", max_size=None) as socket:  # type: ignore[arg-type]
        for _ in range(20):
            writer.append(full_trace)
        with pytest.raises(TimeoutError):
            socket.recv(timeout=0.2)
        socket.send(json.dumps({"from": 0, "state": "running"}))
        message = socket.recv(timeout=10)
        assert len(message) < (1 << 22)
        with pytest.raises(TimeoutError):
            socket.recv(timeout=0.2)
    writer.close()


def test_size_of_a_message_is_limited(
    client: TestClient, writer: LiveFileWriter, full_trace: Trace, monkeypatch: Any
) -> None:
    writer.append(full_trace)
    monkeypatch.setattr("beliefscope.app.api.live.MAX_BLOCK", 5 * bytes_per_step(writer))
    first, parts = 0, []
    with client.websocket_connect("/api/live/run") as socket:
        while first < STEPS:
            head, buffer = request_block(socket, first)
            assert 0 < head["steps"] <= 5
            parts.append(values(head, buffer))
            first += head["steps"]
    assert_equal({name: np.concatenate([p[name] for p in parts]) for name in parts[0]}, expected(full_trace))


def bytes_per_step(writer: LiveFileWriter) -> int:
    reader = LiveFileReader(writer.path)
    reader.close()
    return reader.bytes_per_step


def test_response_waits_for_the_next_step(client: TestClient, writer: LiveFileWriter, full_trace: Trace) -> None:
    writer.append(part(full_trace, 0, 1))
    with client.websocket_connect("/api/live/run") as socket:
        timer = threading.Timer(0.3, writer.append, [part(full_trace, 1, 2)])
        timer.start()
        head, _ = request_block(socket, 1)
        assert head["steps"] == 1
        timer.join()
        started = time.monotonic()
        head, _ = request_block(socket, 2)
        assert head["steps"] == 0
        assert time.monotonic() - started >= TIMEOUT - 0.1


def test_header_of_a_growing_run(client: TestClient, writer: LiveFileWriter, full_trace: Trace) -> None:
    url = TRACE.format(full_trace.filter)
    assert client.get(url).status_code == 202  # no step yet
    writer.append(part(full_trace, 0, 10))
    header = client.get(url).json()
    assert (header["steps"], header["live"]["state"], header["live"]["expected"]) == (10, "running", STEPS)
    assert header["no_maps"] is None
    assert header["modalities"] == list(full_trace.modalities)
    writer.append(part(full_trace, 10, STEPS))
    writer.finish()
    header = client.get(url).json()
    assert header["steps"] == STEPS
    assert "live" not in header
    content = client.get(f"/api/trace/door/{full_trace.filter}/9/columns?data=live:run").content
    assert_equal(
        values({"columns": header["columns"], "image_bytes": 0, "steps": 0}, content),
        {**expected(full_trace), "images": np.zeros((0, 32, 32))},
    )


def test_maps_of_growing_and_ended_runs_are_equal(
    client: TestClient, writer: LiveFileWriter, full_trace: Trace
) -> None:
    writer.append(part(full_trace, 0, 12))
    store = client.app.state.store  # type: ignore[attr-defined]
    selection = Selection("door", full_trace.filter, 9, data="live:run")
    growing = store.request(selection)
    assert growing.growing
    maps = [growing.map(step, 41) for step in (0, 11)]
    writer.append(part(full_trace, 12, STEPS))
    writer.finish()
    ended = store.request(selection)
    assert not ended.growing
    for likelihood_map in maps:
        np.testing.assert_allclose(
            likelihood_map.log_likelihood, ended.map(likelihood_map.step, 41).log_likelihood, rtol=1e-4, atol=1e-3
        )


def test_states_of_runs(client: TestClient, writer: LiveFileWriter, full_trace: Trace, folder: Path) -> None:
    """A running one, one killed at step 4, and a damaged file."""
    writer.append(part(full_trace, 0, 3))
    killed = LiveFileWriter(folder / "dead.live", full_trace)
    killed.append(part(full_trace, 0, 5))
    killed.close()
    (folder / "torn.live").write_bytes(b"BsL\nnot a run")
    for age, name in enumerate(("run", "dead", "torn")):
        os.utime(folder / f"{name}.live", (1e9 - age, 1e9 - age))
    listed = client.get("/api/live").json()["runs"]
    assert [(run["name"], run["state"]) for run in listed] == [
        ("run", "running"),
        ("dead", "died"),
        ("torn", "damaged"),
    ]
    assert (listed[0]["filter"], listed[0]["steps"], listed[0]["available"]) == (full_trace.filter, 3, True)
    assert listed[1]["message"] == "Live run 'dead' stopped at step 4: its process has exited without closing the file."
    assert "torn.live" in listed[2]["message"]
    assert client.get(TRACE.format(full_trace.filter).replace("run", "dead")).json()["steps"] == 5


def test_run_of_an_unavailable_filter(client: TestClient, folder: Path, full_trace: Trace) -> None:
    """Gaussians and particles have posterior maps; a particle filter's likelihood maps need its networks."""
    other = replace(full_trace, checkpoint_hash="f" * 64)
    writer = LiveFileWriter(folder / "run.live", other)
    writer.append(other)
    run = client.get("/api/live").json()["runs"][0]
    assert (run["filter"], run["available"]) == (f"{full_trace.filter} (live)", False)
    header = client.get(TRACE.format(run["filter"])).json()
    assert header["no_maps"] is None
    assert ("likelihood" in header["missing_quantities"]) == (full_trace.kind == "pf")
    writer.finish()
    missing = client.get(TRACE.format(run["filter"])).json()["missing_quantities"]
    assert missing == header["missing_quantities"]
    assert client.get(f"/api/diagnosis/door/{run['filter']}/9?data=live:run").status_code == 400
    writer.close()


def test_run_without_true_states(client: TestClient, folder: Path, full_trace: Trace) -> None:
    """Values that need the truth are NaN, and maps are centered on the estimate."""
    run = replace(
        full_trace, episode=replace(full_trace.episode, states=np.full_like(full_trace.episode.states, np.nan))
    )
    writer = LiveFileWriter(folder / "run.live", run)
    writer.append(run)
    with client.websocket_connect("/api/live/run") as socket:
        arrays = values(*request_block(socket, 0))
    assert np.isnan(arrays["truth"]).all()
    assert np.isnan(arrays["nees"]).all()
    view = client.post("/api/views", json={}).json()
    with client.websocket_connect(view["socket"]) as socket:
        for serial, finish in enumerate((False, True)):
            if finish:
                writer.finish()
            cursor = {"type": "cursor", "serial": serial, "task": "door", "filter": full_trace.filter, "episode": 9}
            socket.send_json(cursor | {"step": STEPS - 1, "angle": None, "size": 41, "data": "live:run"})
            message = socket.receive_bytes()
            head = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
            assert head["truth"] == [None, None, None]
            assert head["numbers"]["truth"] == [None] * len(head["layers"])
            np.testing.assert_allclose(head["centre"], full_trace.estimate_mean[-1, :2], rtol=1e-5)
            assert socket.receive_json() == {"type": "drawn", "serial": serial, "step": STEPS - 1}
    writer.close()
    failures = client.get(f"/api/failures/door/{full_trace.filter}?data=live:run").json()
    assert [score["total"] for score in failures["scores"] if score["name"] == "error"] == [0]
    assert client.get(f"/api/diagnosis/door/{full_trace.filter}/9?data=live:run").status_code == 202


def test_invalid_requests_for_a_live_run(client: TestClient, writer: LiveFileWriter, full_trace: Trace) -> None:
    writer.append(part(full_trace, 0, 6))
    for url, message in {
        "/api/trace/door/image-ekf/9?data=live:run": "live run 'run' is still running",
        "/api/trace/push/crossmodal-ekf/9?data=live:run": "is of task 'door', episode 9",
        "/api/trace/door/crossmodal-ekf/9?data=live:none": "live run 'none' does not exist",
        "/api/trace/door/crossmodal-ekf/9?data=live:../secret": "does not exist",
        "/api/failures/door/crossmodal-ekf?data=live:run": "live run 'run' is still running",
        "/api/diagnosis/door/crossmodal-ekf/9?data=live:run": "live run 'run' is still running",
    }.items():
        answer = client.get(url)
        assert (answer.status_code, message in answer.json()["error"]) == (400, True), answer.text
    with client.websocket_connect("/api/live/run") as socket:
        socket.send_text('{"from": -1}')
        assert socket.receive()["code"] == 4000


def test_another_filter_on_an_ended_run(client: TestClient, writer: LiveFileWriter, full_trace: Trace) -> None:
    writer.append(full_trace)
    writer.finish()
    url = "/api/trace/door/image-ekf/9?data=live:run"
    deadline = time.monotonic() + 30.0
    while (answer := client.get(url)).status_code == 202:
        assert time.monotonic() < deadline
    assert answer.json()["steps"] == STEPS


def test_failures_of_an_ended_run(client: TestClient, writer: LiveFileWriter, full_trace: Trace) -> None:
    writer.append(full_trace)
    writer.finish()
    failures = client.get(f"/api/failures/door/{full_trace.filter}?data=live:run").json()
    assert (failures["data"], failures["steps"], failures["faults"]) == ("live:run", STEPS, "")
    by_error = next(score for score in failures["scores"] if score["name"] == "error")
    survey = Survey.from_episodes([EpisodeScores.from_trace(full_trace)])
    events = failures_of(survey, "error").events
    assert [(e["step"], e["value"]) for e in by_error["events"]] == [(e.step, e.score) for e in events]
    assert {e["episode"] for e in by_error["events"]} == {9}
    assert "data=live%3Arun" in by_error["events"][0]["link"]
    refused = client.post(f"/api/failures/door/{full_trace.filter}?data=live:run")
    assert "a single episode, not a data set" in refused.json()["error"]


def test_an_ended_run_has_a_preliminary_diagnosis(
    client: TestClient, writer: LiveFileWriter, full_trace: Trace
) -> None:
    blind = replace(full_trace.episode, observations={key: 0 * v for key, v in full_trace.episode.observations.items()})
    writer.append(replace(full_trace, episode=blind))
    writer.finish()
    answer = client.get(f"/api/diagnosis/door/{full_trace.filter}/9?data=live:run")
    assert answer.status_code == 202, answer.text
    reply = answer.json()
    assert reply["job"] is None
    assert reply["preliminary"]["causes"][0]["next"]


def poll(client: TestClient, url: str) -> dict[str, Any]:
    deadline = time.monotonic() + 60.0
    while (answer := client.get(url)).status_code == 202:
        assert time.monotonic() < deadline
    assert answer.status_code == 200, answer.text
    result: dict[str, Any] = answer.json()
    return result


@pytest.mark.long
def test_recording_comparison_and_diagnostics(
    client: TestClient, writer: LiveFileWriter, full_trace: Trace, settings: Any
) -> None:
    """A recording contains the steps so far; the others need the end of the run."""
    body = {"task": "door", "filter": full_trace.filter, "episode": 9, "data": "live:run", "maps": 4}
    written = []
    for first, last in ((0, 10), (10, STEPS)):
        writer.append(part(full_trace, first, last))
        answer = client.post("/api/recordings", json=body)
        assert answer.status_code == 201, answer.text
        written.append(read_recording(settings.workspace / "recordings" / answer.json()["name"]))
    assert [len(run) for run in written] == [10, STEPS]
    np.testing.assert_array_equal(written[1].estimate_mean, full_trace.estimate_mean)
    writer.finish()
    path = f"door/{full_trace.filter}/9"
    comparison = poll(client, f"/api/compare/{path}?data=live:run&against=filter%3Dimage-ekf")
    assert comparison["names"] == [full_trace.filter, "image-ekf"]
    entries = {entry["name"]: entry for entry in client.get(f"/api/diagnostics/{path}?data=live:run").json()}
    name = next(name for name, entry in entries.items() if not entry["slow"] and not entry["why_not"])
    assert poll(client, f"/api/diagnostics/{name}/{path}?data=live:run")["trajectories"] == 1


def test_growing_recording_is_streamed(client: TestClient, writer: LiveFileWriter, full_trace: Trace) -> None:
    writer.append(part(full_trace, 0, 1))
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

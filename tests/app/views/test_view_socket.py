"""Socket of a view: maps and scene updates for cursors, skipped cursors, invalid messages."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient, WebSocketTestSession
from starlette.websockets import WebSocketDisconnect

from beliefscope.app.protocol.map_format import LOG_RANGE, quantise
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.maps.map_statistics import measure_maps
from beliefscope.inspect.statistics.measures import particle_log_weights
from beliefscope.inspect.trace import load_trace

pytestmark = pytest.mark.slow


def cursor(serial: int = 1, **changes: Any) -> dict[str, Any]:
    message = {"type": "cursor", "serial": serial, "task": "door", "filter": "crossmodal-pf", "episode": 1, "step": 7}
    return message | {"angle": None, "size": 41} | changes


def maps(socket: WebSocketTestSession) -> tuple[dict[str, Any], np.ndarray[Any, Any]]:
    return read(socket.receive_bytes())


def read(data: bytes) -> tuple[dict[str, Any], np.ndarray[Any, Any]]:
    length = int.from_bytes(data[:4], "little")
    header = json.loads(data[4 : 4 + length])
    start = 4 + length + -length % 4
    assert start % 4 == 0
    layers = len(header["layers"])
    count = header["particles"] * (2 + layers)
    header["cloud"] = np.frombuffer(data, "<f4", count, offset=start)
    shape = (layers, header["size"], header["size"])
    return header, np.frombuffer(data, "<u2", offset=start + 4 * count).reshape(shape)


@pytest.fixture
def socket(client: TestClient, trace_url: str) -> Any:
    view = client.post("/api/views").json()
    with client.websocket_connect(view["socket"]) as socket:
        yield socket


@pytest.fixture(scope="module")
def shared_socket(shared_client: TestClient, shared_trace_url: str) -> Iterator[WebSocketTestSession]:
    """Socket of a view for tests that leave nothing behind."""
    view = shared_client.post("/api/views").json()
    with shared_client.websocket_connect(view["socket"]) as socket:
        yield socket


@pytest.mark.parametrize("size", [41, 135])
def test_a_cursor_is_answered_with_maps_then_the_scene(
    socket: WebSocketTestSession, settings: Settings, size: int
) -> None:
    socket.send_json(cursor(serial=3, size=size, angle=0.4))
    header, layers = maps(socket)
    assert socket.receive_json() == {"type": "drawn", "serial": 3, "step": 7}
    trace = load_trace(next((settings.workspace / "traces").iterdir()))
    expected = MapEngine(load_checkpoint(settings.checkpoints["crossmodal-pf"]), trace).map(7, angle=0.4, size=size)
    log_max, log_range = (np.array(header[key])[:, None, None] for key in ("log_max", "log_range"))
    decoded = log_max + log_range * (layers / 65535.0 - 1.0)
    # The quantization error is at most half of 64 nats / 65535; all layers of this filter lie within 64 nats.
    assert log_range.max() < LOG_RANGE
    np.testing.assert_allclose(decoded, expected.log_likelihood, rtol=0, atol=0.5 * LOG_RANGE / 65535 + 1e-6)
    assert (layers.max(axis=(1, 2)) == 65535).all()
    particles, weights = np.split(header["cloud"], [2 * header["particles"]])
    np.testing.assert_array_equal(particles.reshape(-1, 2), trace.particles[7, :, :2])
    weights = weights.reshape(3, -1)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-5)  # sums of float32
    np.testing.assert_allclose(weights, np.exp(particle_log_weights(trace)[7]), rtol=1e-4, atol=1e-7)
    measured = measure_maps([expected], trace)
    for name, value in header["numbers"].items():
        np.testing.assert_allclose(value, getattr(measured, name)[0], rtol=1e-12)
    assert header["layers"] == ["image", "haptics", "fused"]
    assert (header["serial"], header["step"], header["size"], header["angle"]) == (3, 7, size, 0.4)
    assert [axis["half_width"] for axis in header["axes"]] == pytest.approx([0.135, 0.135])
    np.testing.assert_allclose(header["peak"], expected.peaks(), rtol=1e-6)
    np.testing.assert_allclose(header["truth"], trace.episode.states[7], rtol=1e-6)
    np.testing.assert_allclose(header["effector"], trace.episode.observations["effector_position"][7, :2], rtol=1e-6)


def test_values_below_the_range_are_clipped() -> None:
    log = np.array([[[0.0, -63.0], [-64.0, -2000.0]], [[5.0, 5.0], [5.0, 5.0]]], dtype=np.float32)
    cells, log_max, log_range = quantise(log)
    assert log_max.tolist() == [0.0, 5.0]
    assert log_range[0] == LOG_RANGE
    assert cells[0, 1].tolist() == [0, 0]
    assert cells[0, 0, 1] == round(65535 / 64)
    assert (cells[1] == 65535).all()  # a flat layer


def test_faults_change_the_maps(socket: WebSocketTestSession) -> None:
    layers = []
    for serial, faults in enumerate(("", "blackout", "")):
        socket.send_json(cursor(serial=serial, faults=faults))
        layers.append(maps(socket)[1])
        assert socket.receive_json()["type"] == "drawn"
    assert np.array_equal(layers[0], layers[2])
    assert not np.array_equal(layers[0][0], layers[1][0])


def test_outdated_cursors_are_skipped(
    socket: WebSocketTestSession, monkeypatch: pytest.MonkeyPatch, client: TestClient
) -> None:
    busy, resume = threading.Event(), threading.Event()
    original = TracedRun.map

    def slow(self: TracedRun, *arguments: Any) -> Any:
        busy.set()
        assert resume.wait(10.0)
        return original(self, *arguments)

    monkeypatch.setattr(TracedRun, "map", slow)
    socket.send_json(cursor(serial=1, step=1))
    assert busy.wait(10.0)
    for serial in range(2, 9):
        socket.send_json(cursor(serial=serial, step=serial))
    socket.send_text("not JSON")  # messages are processed in order
    assert socket.receive_json()["type"] == "error"
    resume.set()
    answered, scene_serials = [], []
    while 8 not in answered or 8 not in scene_serials:
        message = socket.receive()
        if "bytes" in message:
            answered.append(read(message["bytes"])[0]["serial"])
        else:
            scene_serials.append(json.loads(message["text"])["serial"])
    assert answered == [1, 8]
    assert scene_serials in ([8], [1, 8])  # the first may be replaced while it waits for the scene


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("not json", "Invalid JSON"),
        ("[1]", "Input should be an object"),
        ("{}", "Unable to extract tag using discriminator 'type'"),
        (json.dumps(cursor(task="nothing")), "task 'nothing' does not exist"),
        (json.dumps(cursor(filter="nothing")), "filter 'nothing' does not exist"),
        (json.dumps(cursor(filter=3)), "cursor.filter: Input should be a valid string."),
        (json.dumps(cursor(episode=9)), "episode 9 does not exist"),
        (json.dumps(cursor(step=40)), "step 40 does not exist. Available: 0 to 39."),
        (json.dumps(cursor(step=-1)), "cursor.step: Input should be greater than or equal to 0."),
        (json.dumps(cursor(step=1.5)), "cursor.step: Input should be a valid integer."),
        (json.dumps(cursor(step=True)), "cursor.step: Input should be a valid integer."),
        (json.dumps(cursor(faults=0.4)), "cursor.faults: Input should be a valid string."),
        (
            json.dumps(cursor(faults="blakout")),
            "fault 'blakout' does not exist. Did you mean blackout? Available: blackout,",
        ),
        (json.dumps(cursor(faults="delay=touch")), "modality 'touch' of task 'door' does not exist."),
        (json.dumps(cursor(size=10**6)), "cursor.size: Input should be 41 or 135."),
        (json.dumps(cursor(angle="wide")), "cursor.angle: Input should be a valid number."),
        (json.dumps(cursor(angle=float("nan"))), "cursor.angle: Input should be a finite number."),
    ],
)
def test_invalid_messages_are_answered_with_an_error(
    shared_socket: WebSocketTestSession, text: str, error: str
) -> None:
    shared_socket.send_text(text)
    answer = shared_socket.receive_json()
    assert answer["type"] == "error"
    assert error in answer["error"]
    shared_socket.send_json(cursor(serial=2))
    assert maps(shared_socket)[0]["serial"] == 2
    assert shared_socket.receive_json()["type"] == "drawn"


def test_internal_errors_are_reported(socket: WebSocketTestSession, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(TracedRun, "map", lambda *_: 1 / 0)
        socket.send_json(cursor(serial=4))
        answer = socket.receive_json()
    assert answer == {"type": "error", "serial": 4, "error": "The server failed: division by zero"}
    socket.send_json(cursor(serial=5))
    assert maps(socket)[0]["serial"] == 5


def test_unknown_views_are_rejected(client: TestClient) -> None:
    for path in ("/api/views/none", "/scene/none"):
        with client.websocket_connect(path) as socket, pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_text()
        assert closed.value.code == 4004


def test_a_second_page_replaces_the_first(client: TestClient, trace_url: str) -> None:
    address = client.post("/api/views").json()["socket"]
    with client.websocket_connect(address) as first, client.websocket_connect(address) as second:
        with pytest.raises(WebSocketDisconnect) as closed:
            first.receive_text()
        assert closed.value.code == 4000
        second.send_json(cursor())
        assert maps(second)[0]["serial"] == 1

"""Load: memory of traces, queue limits, scheduling, slow clients."""

from __future__ import annotations

import asyncio
import gc
import json
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from starlette.testclient import TestClient
from websockets.sync.client import connect
from websockets.typing import Origin

from beliefscope.app.api import recordings
from beliefscope.app.runs import trace_store, traced_run
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TRACES_IN_MEMORY, TraceStore
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.views.registry import Views
from beliefscope.app.views.scheduler import DeadlineExecutor, held_with_pause
from beliefscope.app.views.view_socket import PREFETCH_STEPS
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.maps.likelihood_map import MapOptions
from beliefscope.recordings.probe import RecordingInfo, RecordingProbe

pytestmark = pytest.mark.slow

TIMEOUT = 30.0  # s


@pytest.fixture
def store(settings: Settings) -> Iterator[TraceStore]:
    store = TraceStore(settings)
    yield store
    store.close()


def faulty_run(number: int, filter_: str = "crossmodal-ekf") -> Selection:
    """One of many runs of an episode."""
    return Selection("door", filter_, 1, Faults.parse(f"blackout=0.{number:02d}"))


def request_runs(store: TraceStore, count: int) -> list[weakref.ref[TracedRun]]:
    refs = []
    for number in range(1, count + 1):
        run = store.request(faulty_run(number))
        run.future.result(TIMEOUT)
        refs.append(weakref.ref(run))
    return refs


def count_alive(refs: list[weakref.ref[Any]]) -> int:
    gc.collect()
    return sum(ref() is not None for ref in refs)


def test_memory_holds_the_newest_traces_not_all_that_were_request_runs(store: TraceStore) -> None:
    refs = request_runs(store, TRACES_IN_MEMORY + 4)
    # The worker thread may still hold the last one.
    assert TRACES_IN_MEMORY <= count_alive(refs) <= TRACES_IN_MEMORY + 1
    assert refs[-1]() is not None
    assert refs[0]() is None


@pytest.mark.long
def test_memory_of_traces_is_limited(store: TraceStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trace_store, "BYTES_IN_MEMORY", 1)
    assert count_alive(request_runs(store, 4)) <= 2
    assert store.cached(faulty_run(4)) is not None


def test_trace_in_use_is_kept_and_shared(store: TraceStore) -> None:
    run = store.request(faulty_run(90))
    run.future.result(TIMEOUT)
    request_runs(store, TRACES_IN_MEMORY + 1)
    assert store.request(faulty_run(90)) is run


def test_number_of_cached_keys_is_limited(store: TraceStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trace_store, "MAX_KEYS", 3)
    store = TraceStore(store.settings)
    keys = [store.key(faulty_run(number)) for number in range(1, 8)]
    assert store._key.cache_info().currsize == 3
    assert [store.key(faulty_run(number)) for number in range(1, 8)] == keys
    store.close()


def test_number_of_waiting_runs_is_limited(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trace_store, "MAX_WAITING", 3)
    store: TraceStore = client.app.state.store  # type: ignore[attr-defined]
    proceed = threading.Event()
    store._executor.submit(proceed.wait, TIMEOUT)
    responses = [
        client.get("/api/trace/door/crossmodal-ekf/1", params={"faults": f"blackout=0.{i}"}) for i in range(1, 6)
    ]
    assert [answer.status_code for answer in responses] == [202, 202, 202, 429, 429]
    assert "3 filter runs are waiting already" in responses[-1].json()["error"]
    assert client.get("/api/trace/door/crossmodal-ekf/1", params={"faults": "blackout=0.3"}).status_code == 202
    assert client.get("/api/trace/door/crossmodal-ekf/1/columns", params={"faults": "blackout=0.3"}).status_code == 202
    proceed.set()
    store.request(faulty_run(30)).future.result(TIMEOUT)
    assert client.get("/api/trace/door/crossmodal-ekf/1", params={"faults": "blackout=0.5"}).status_code in (200, 202)


def test_slow_reader_of_recordings_does_not_block_others(
    address: str, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    proceed = threading.Event()

    def slow(_: RecordingProbe, path: Path) -> RecordingInfo:
        proceed.wait(TIMEOUT)
        return RecordingInfo(problem="unreadable")

    monkeypatch.setattr(RecordingProbe, "__call__", slow)
    headers = {"Origin": f"http://{address}"}

    def put(number: int) -> int:
        url = f"http://{address}/api/recordings/{number}.rrd"
        try:
            with urlopen(Request(url, b"RRF2", headers, method="PUT"), timeout=TIMEOUT) as answer:
                return int(answer.status)
        except HTTPError as error:
            return error.code

    count = (os.cpu_count() or 2) + 6  # more than asyncio's threads
    with ThreadPoolExecutor(count) as clients:
        statuses = clients.map(put, range(count))
        deadline = time.monotonic() + TIMEOUT
        while len(list((settings.workspace / "recordings").glob(".*.part"))) < count:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        try:
            with urlopen(Request(f"http://{address}/api/views", b"", headers), timeout=10.0) as answer:
                assert answer.status == 201
        finally:
            proceed.set()
        assert set(statuses) == {400}
    assert not list((settings.workspace / "recordings").glob(".*"))


def test_disk_fills_during_upload(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    free = iter([recordings.RESERVED_SPACE + 10**9, *[recordings.RESERVED_SPACE - 1] * 10])
    monkeypatch.setattr(recordings, "free_space", lambda _: next(free))
    monkeypatch.setattr(recordings, "CHECK_INTERVAL", 1000)
    folder = client.app.state.store.settings.workspace / "recordings"  # type: ignore[attr-defined]
    answer = client.put("/api/recordings/x.rrd", content=(b"RRF2" + bytes(596) for _ in range(10)))
    assert answer.status_code == 413
    assert not list(folder.iterdir())


def test_maps_are_cached(store: TraceStore, monkeypatch: pytest.MonkeyPatch) -> None:
    run = store.request(faulty_run(1, "crossmodal-pf"))
    run.future.result(TIMEOUT)
    maps = run.encoded_maps(3, 41)
    assert run.encoded_maps(3, 41) is maps
    assert run.encoded_maps(3, 41, MapOptions(0.1)) is not maps
    assert maps.message(5)[4:].startswith(b'{"type": "maps", "serial": 5, "other": false, "step": 3')
    monkeypatch.setattr(traced_run, "MAP_CACHE_BYTES", 3 * maps.nbytes)
    for step in range(10):
        run.encoded_maps(step, 41)
    assert len(run._cache) == 3
    assert run._cache_bytes == sum(maps.nbytes for maps in run._cache.values())


def test_neighbouring_maps_are_prefetched(client: TestClient) -> None:
    view = client.post("/api/views").json()
    selection = {"task": "door", "filter": "crossmodal-ekf", "episode": 1}
    store: TraceStore = client.app.state.store  # type: ignore[attr-defined]
    with client.websocket_connect(view["socket"]) as socket:
        socket.send_json({"type": "cursor", "serial": 1, "step": 3, "angle": None, "size": 41, **selection})
        assert len(socket.receive_bytes()) > 0
        run = store.request(Selection("door", "crossmodal-ekf", 1))
        assert run.missing_maps(3, 4, MapOptions(0.1)) == [3, 2, 4, 1]
        deadline = time.monotonic() + TIMEOUT
        while run.missing_maps(3, PREFETCH_STEPS, MapOptions()):
            assert time.monotonic() < deadline
            time.sleep(0.01)


@pytest.mark.long
def test_closed_views_are_released(open_client: Callable[..., TestClient], settings: Settings) -> None:
    with open_client(settings) as client:
        views: Views = client.app.state.views  # type: ignore[attr-defined]
        views._patience = 0.0
        refs: list[weakref.ref[Any]] = []
        before = threading.active_count()
        for number in range(1, 4):
            view = client.post("/api/views").json()
            selection = {"task": "door", "filter": "crossmodal-ekf", "episode": 1, "faults": f"blackout=0.{number:02d}"}
            with client.websocket_connect(view["socket"]) as socket:
                socket.send_json({"type": "cursor", "serial": 1, "step": 3, "angle": None, "size": 41, **selection})
                assert len(socket.receive_bytes()) > 0
                assert socket.receive_json()["type"] == "drawn"
            current = views[view["view"]]
            refs += [weakref.ref(part) for part in (current, current.scene, current.scene.viser.server)]
            del current
            client.portal.call(views._close_idle, 0)  # type: ignore[union-attr]
        assert len(views) == 0
        assert count_alive(refs) == 0
        # Threads of the executor and of the event loop are shared by all views.
        assert threading.active_count() <= before + 14


def test_number_of_views_is_limited(settings: Settings) -> None:
    async def scenario() -> str:
        views = Views(TraceStore(settings), limit=1)
        (await views.open(False)).idle_since = None  # in use
        with pytest.raises(BadInput) as error:
            await views.open(False)
        await views.close()
        return str(error.value)

    assert asyncio.run(scenario()).startswith("The maximum number of pages is open, 1.")


def test_executor_runs_earliest_deadline_first_and_resources_exclusively() -> None:
    async def scenario() -> tuple[list[str], int]:
        executor, proceed = DeadlineExecutor(threads=1), threading.Event()
        order: list[str] = []
        first = asyncio.ensure_future(executor.run(lambda: proceed.wait(TIMEOUT), 0.0))
        await asyncio.sleep(0)  # it starts, and the others wait
        others = [
            asyncio.ensure_future(executor.run(lambda name=name: order.append(name), within))  # type: ignore[misc]
            for name, within in (("fine", 3.0), ("scene", 2.0), ("coarse", 1.0), ("late scene", 2.5))
        ]
        await asyncio.sleep(0)
        others[3].cancel()
        await asyncio.sleep(0.01)
        assert 0.01 <= executor.overdue() < TIMEOUT, "the first task was due immediately"
        proceed.set()
        await asyncio.gather(first, *others[:3])
        assert executor.overdue() == 0.0
        executor.close()

        executor, inside, maximum = DeadlineExecutor(threads=4), [0], [0]

        def exclusive() -> None:
            inside[0] += 1
            maximum[0] = max(maximum[0], inside[0])
            threading.Event().wait(0.002)
            inside[0] -= 1

        await asyncio.gather(*(executor.run(exclusive, 0.0, frozenset({"engine"})) for _ in range(20)))
        executor.close()
        return order, maximum[0]

    assert asyncio.run(scenario()) == (["coarse", "scene", "fine"], 1)


def test_a_lock_pauses_after_each_holder() -> None:
    async def scenario() -> list[tuple[str, float]]:
        lock, events = asyncio.Lock(), []

        async def hold(name: str) -> None:
            async with held_with_pause(lock, pause=2.0, max_pause=60.0):
                events.append((name, time.monotonic()))
                await asyncio.sleep(0.02)
                events.append((name, time.monotonic()))
                if name == "second":
                    raise ValueError(name)

        await asyncio.gather(*(hold(name) for name in ("first", "second", "third")), return_exceptions=True)
        return events

    events = asyncio.run(scenario())
    assert [name for name, _ in events] == ["first", "first", "second", "second", "third", "third"]
    times = [at for _, at in events]
    for i in (0, 2):
        # The pause is twice as long as the lock was held, within the resolution of the timers.
        assert times[i + 2] - times[i + 1] >= 2.0 * (times[i + 1] - times[i]) - 0.002


def test_executor_propagates_errors_and_refuses_tasks_after_close() -> None:
    async def scenario() -> None:
        executor = DeadlineExecutor(threads=1)
        with pytest.raises(ZeroDivisionError):
            await executor.run(lambda: 1 / 0, 0.0)
        assert await executor.run(lambda: 3, 0.0) == 3
        executor.close()
        with pytest.raises(RuntimeError, match="stopping"):
            await executor.run(lambda: 3, 0.0)

    asyncio.run(scenario())


def test_client_that_does_not_read_is_not_buffered(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[int] = []
    original = TracedRun.encoded_maps

    def counted(self: TracedRun, step: int, *arguments: Any) -> Any:
        steps.append(step)
        return original(self, step, *arguments)

    monkeypatch.setattr(TracedRun, "encoded_maps", counted)
    origin = Origin(f"http://{address}")

    def view() -> str:
        request = Request(f"http://{address}/api/views", method="POST", headers={"Origin": str(origin)})
        with urlopen(request) as answer:
            return f"ws://{address}{json.load(answer)['socket']}"

    def cursor(serial: int) -> str:
        selection = {"task": "door", "filter": "crossmodal-ekf", "episode": 1, "size": 135, "scene": False}
        return json.dumps({"type": "cursor", "serial": serial, "step": serial % 40, "angle": None, **selection})

    # With a full queue the client stops reading from its socket.
    with connect(view(), origin=origin, max_queue=1, proxy=None) as stalled:
        for serial in range(1500):
            stalled.send(cursor(serial))
        with connect(view(), origin=origin, max_size=None, proxy=None) as other:
            other.send(cursor(1))
            assert isinstance(other.recv(timeout=TIMEOUT), bytes)
        # Maps of 130 KB each fill the system's buffers; the other cursors were replaced by newer ones.
        assert len(steps) < 100

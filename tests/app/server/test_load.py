"""Many at once, and for long: work by its due time, traces that nobody shows let go, browsers that do not read."""

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
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TRACES_IN_MEMORY, TraceStore
from beliefscope.app.runs.settings import Settings
from beliefscope.app.views.scheduler import DeadlineExecutor, FairLock
from beliefscope.app.views.registry import Views
from beliefscope.app.views.view import PREFETCH_STEPS
from beliefscope.app.workspace.recording_probe import RecordingInfo, RecordingProbe
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults

PATIENCE = 30.0  # s


@pytest.fixture
def store(settings: Settings) -> Iterator[TraceStore]:
    store = TraceStore(settings)
    yield store
    store.close()


def broken(number: int, filter_: str = "crossmodal-ekf") -> Selection:
    """One of many runs of the same episode."""
    return Selection("door", filter_, 1, Faults.parse(f"blackout=0.{number:02d}"))


def opened(store: TraceStore, count: int) -> list[weakref.ref[TracedRun]]:
    found = []
    for number in range(1, count + 1):
        traced = store.request(broken(number))
        traced.result(PATIENCE)
        found.append(weakref.ref(traced))
    return found


def living(refs: list[weakref.ref[Any]]) -> int:
    gc.collect()
    return sum(ref() is not None for ref in refs)


def test_memory_holds_the_newest_traces_not_all_that_were_opened(store: TraceStore) -> None:
    refs = opened(store, TRACES_IN_MEMORY + 4)
    # The thread that traced the last one may not have let go of it yet.
    assert TRACES_IN_MEMORY <= living(refs) <= TRACES_IN_MEMORY + 1
    assert refs[-1]() is not None
    assert refs[0]() is None


def test_large_traces_count_by_their_bytes(store: TraceStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trace_store, "BYTES_IN_MEMORY", 1)
    assert living(opened(store, 4)) <= 2
    assert store.cached(broken(4)) is not None


def test_a_trace_that_somebody_shows_stays_and_is_the_others_too(store: TraceStore) -> None:
    shown = store.request(broken(90))
    shown.result(PATIENCE)
    opened(store, TRACES_IN_MEMORY + 1)
    assert store.request(broken(90)) is shown


def test_names_of_what_was_opened_are_forgotten(store: TraceStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trace_store, "MAX_KEYS", 3)
    keys = [store.key(broken(number)) for number in range(1, 8)]
    assert len(store._keys) == 3
    assert [store.key(broken(number)) for number in range(1, 8)] == keys


def test_so_many_runs_wait_and_no_more(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trace_store, "MAX_WAITING", 3)
    served: TraceStore = client.app.state.store  # type: ignore[attr-defined]
    go_on = threading.Event()
    served._executor.submit(go_on.wait, PATIENCE)
    asked = [client.get("/api/trace/door/crossmodal-ekf/1", params={"faults": f"blackout=0.{i}"}) for i in range(1, 6)]
    assert [answer.status_code for answer in asked] == [202, 202, 202, 429, 429]
    assert "3 filter runs are waiting already" in asked[-1].json()["error"]
    assert client.get("/api/trace/door/crossmodal-ekf/1", params={"faults": "blackout=0.3"}).status_code == 202
    assert client.get("/api/trace/door/crossmodal-ekf/1/columns", params={"faults": "blackout=0.3"}).status_code == 202
    go_on.set()
    served.request(broken(30)).result(PATIENCE)
    assert client.get("/api/trace/door/crossmodal-ekf/1", params={"faults": "blackout=0.5"}).status_code in (200, 202)


def test_recordings_that_are_read_for_long_hold_up_nobody_else(
    address: str, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def slow(_: RecordingProbe, path: Path) -> RecordingInfo:
        go_on.wait(PATIENCE)
        return RecordingInfo(problem="read at last")

    monkeypatch.setattr(RecordingProbe, "__call__", slow)
    headers = {"Origin": f"http://{address}"}

    def put(number: int) -> int:
        url = f"http://{address}/api/recordings/{number}.rrd"
        try:
            with urlopen(Request(url, b"RRF2", headers, method="PUT"), timeout=PATIENCE) as answer:
                return int(answer.status)
        except HTTPError as error:
            return error.code

    count = (os.cpu_count() or 2) + 6  # more than asyncio has threads for all that waits
    with ThreadPoolExecutor(count) as browsers:
        added = browsers.map(put, range(count))
        until = time.monotonic() + PATIENCE
        while len(list((settings.workspace / "recordings").glob(".*.part"))) < count:
            assert time.monotonic() < until
            time.sleep(0.01)
        try:
            with urlopen(Request(f"http://{address}/api/views", b"", headers), timeout=10.0) as answer:
                assert answer.status == 201
        finally:
            go_on.set()
        assert set(added) == {400}
    assert not list((settings.workspace / "recordings").glob(".*"))


def test_what_others_add_meanwhile_leaves_no_room(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    free = iter([recordings.SPARED + 10**9, *[recordings.SPARED - 1] * 10])
    monkeypatch.setattr(recordings, "disk", lambda _: next(free))
    monkeypatch.setattr(recordings, "LOOK", 1000)
    folder = client.app.state.store.settings.workspace / "recordings"  # type: ignore[attr-defined]
    answer = client.put("/api/recordings/x.rrd", content=(b"RRF2" + bytes(596) for _ in range(10)))
    assert answer.status_code == 413
    assert not list(folder.iterdir())


def test_maps_are_made_once_for_all_who_look(store: TraceStore, monkeypatch: pytest.MonkeyPatch) -> None:
    traced = store.request(broken(1, "crossmodal-pf"))
    traced.result(PATIENCE)
    one = traced.encoded_maps(3, None, 41)
    assert traced.encoded_maps(3, None, 41) is one
    assert traced.encoded_maps(3, 0.1, 41) is not one
    assert one.message(5)[4:].startswith(b'{"type": "maps", "serial": 5, "other": false, "step": 3')
    monkeypatch.setattr(traced_run, "MAP_CACHE_BYTES", 3 * one.nbytes)
    for step in range(10):
        traced.encoded_maps(step, None, 41)
    assert len(traced._kept) == 3
    assert traced._kept_bytes == sum(kept.nbytes for kept in traced._kept.values())


def test_while_a_hand_rests_the_maps_about_it_are_made(client: TestClient) -> None:
    view = client.post("/api/views").json()
    chosen = {"task": "door", "filter": "crossmodal-ekf", "episode": 1}
    served: TraceStore = client.app.state.store  # type: ignore[attr-defined]
    with client.websocket_connect(view["socket"]) as socket:
        socket.send_json({"type": "cursor", "serial": 1, "step": 3, "angle": None, "size": 41, **chosen})
        assert len(socket.receive_bytes()) > 0
        traced = served.request(Selection("door", "crossmodal-ekf", 1))
        assert traced.missing_maps(3, 0.1, 4) == [3, 2, 4, 1]
        until = time.monotonic() + PATIENCE
        while traced.missing_maps(3, None, PREFETCH_STEPS):
            assert time.monotonic() < until
            time.sleep(0.01)


def test_a_closed_view_leaves_nothing_behind(open_client: Callable[..., TestClient], settings: Settings) -> None:
    with open_client(settings) as client:
        views: Views = client.app.state.views  # type: ignore[attr-defined]
        views._patience = 0.0
        refs: list[weakref.ref[Any]] = []
        before = threading.active_count()
        for number in range(1, 4):
            view = client.post("/api/views").json()
            chosen = {"task": "door", "filter": "crossmodal-ekf", "episode": 1, "faults": f"blackout=0.{number:02d}"}
            with client.websocket_connect(view["socket"]) as socket:
                socket.send_json({"type": "cursor", "serial": 1, "step": 3, "angle": None, "size": 41, **chosen})
                assert len(socket.receive_bytes()) > 0
                assert socket.receive_json()["type"] == "drawn"
            open_ = views[view["view"]]
            refs += [weakref.ref(each) for each in (open_, open_.scene, open_.scene.viser.server)]
            del open_
            client.portal.call(views._close_idle, 0)  # type: ignore[union-attr]
        assert len(views) == 0
        assert living(refs) == 0
        # The desk's, and those in which the event loop waits for what blocks; each is there once.
        assert threading.active_count() <= before + 14


def test_one_page_too_many_is_told_how_many_there_may_be(settings: Settings) -> None:
    async def scenario() -> str:
        views = Views(TraceStore(settings), limit=1)
        (await views.open(False)).idle_since = None  # its page is there
        with pytest.raises(BadInput) as told:
            await views.open(False)
        await views.close()
        return str(told.value)

    assert asyncio.run(scenario()).startswith("The maximum number of pages is open, 1.")


def test_the_desk_takes_what_is_due_first_and_never_two_that_need_the_same() -> None:
    async def scenario() -> tuple[list[str], int]:
        desk, go_on = DeadlineExecutor(threads=1), threading.Event()
        order: list[str] = []
        first = asyncio.ensure_future(desk.run(lambda: go_on.wait(PATIENCE), 0.0))
        await asyncio.sleep(0)  # it is taken up, and the others queue
        others = [
            asyncio.ensure_future(desk.run(lambda name=name: order.append(name), within))  # type: ignore[misc]
            for name, within in (("fine", 3.0), ("scene", 2.0), ("coarse", 1.0), ("late scene", 2.5))
        ]
        await asyncio.sleep(0)
        others[3].cancel()  # whose page has gone meanwhile
        await asyncio.sleep(0.01)
        assert 0.01 <= desk.overdue() < PATIENCE, "of the first, which was due at once"
        go_on.set()
        await asyncio.gather(first, *others[:3])
        assert desk.overdue() == 0.0
        desk.close()

        desk, inside, most = DeadlineExecutor(threads=4), [0], [0]

        def alone() -> None:
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            threading.Event().wait(0.002)
            inside[0] -= 1

        await asyncio.gather(*(desk.run(alone, 0.0, frozenset({"engine"})) for _ in range(20)))
        desk.close()
        return order, most[0]

    assert asyncio.run(scenario()) == (["coarse", "scene", "fine"], 1)


def test_one_after_the_other_has_its_turn_and_a_rest_follows_each_even_a_failed_one() -> None:
    async def scenario() -> list[tuple[str, float]]:
        turns, told = FairLock(pause=2.0), []

        async def one(name: str) -> None:
            async with turns:
                told.append((name, time.monotonic()))
                await asyncio.sleep(0.02)
                told.append((name, time.monotonic()))
                if name == "second":
                    raise ValueError(name)

        await asyncio.gather(*(one(name) for name in ("first", "second", "third")), return_exceptions=True)
        return told

    told = asyncio.run(scenario())
    assert [name for name, _ in told] == ["first", "first", "second", "second", "third", "third"]
    times = [at for _, at in told]
    for i in (0, 2):
        # A turn that took t is followed by 2 t of rest; clocks and the loop's timers may differ by their resolution.
        assert times[i + 2] - times[i + 1] >= 2.0 * (times[i + 1] - times[i]) - 0.002


def test_the_desk_gives_back_errors_and_refuses_when_it_is_closed() -> None:
    async def scenario() -> None:
        desk = DeadlineExecutor(threads=1)
        with pytest.raises(ZeroDivisionError):
            await desk.run(lambda: 1 / 0, 0.0)
        assert await desk.run(lambda: 3, 0.0) == 3
        desk.close()
        with pytest.raises(RuntimeError, match="stopping"):
            await desk.run(lambda: 3, 0.0)

    asyncio.run(scenario())


def test_a_browser_that_never_reads_costs_no_more_than_what_is_on_its_way(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    real = TracedRun.encoded_maps

    def counted(self: TracedRun, step: int, angle: float | None, size: int) -> Any:
        made.append(step)
        return real(self, step, angle, size)

    monkeypatch.setattr(TracedRun, "encoded_maps", counted)
    origin = Origin(f"http://{address}")

    def view() -> str:
        asked = Request(f"http://{address}/api/views", method="POST", headers={"Origin": str(origin)})
        with urlopen(asked) as answer:
            return f"ws://{address}{json.load(answer)['socket']}"

    def cursor(serial: int) -> str:
        chosen = {"task": "door", "filter": "crossmodal-ekf", "episode": 1, "size": 135, "scene": False}
        return json.dumps({"type": "cursor", "serial": serial, "step": serial % 40, "angle": None, **chosen})

    # Beyond so many messages this client takes nothing more from its socket.
    with connect(view(), origin=origin, max_queue=1, proxy=None) as deaf:
        for serial in range(1500):
            deaf.send(cursor(serial))
        with connect(view(), origin=origin, max_size=None, proxy=None) as other:
            other.send(cursor(1))
            assert isinstance(other.recv(timeout=PATIENCE), bytes)
        # 130 KB each: what fits the system's buffers of one connection. The other 1400 cursors were overtaken.
        assert len(made) < 100

"""viser behind our port: its sockets come through ours, it opens none, and nothing of it stays."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import msgspec
import pytest
import viser
import websockets.asyncio.server
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from beliefscope.app.server.main import Settings
from beliefscope.app.views.embedded_viser import BROWSERS, EmbeddedViser
from beliefscope.app.views.view import Views

PROTOCOL = f"viser-v{viser.__version__}"


def listening() -> set[str]:
    """Addresses on which this process listens."""
    folder = Path("/proc/self")
    if not (folder / "net/tcp").exists():
        pytest.skip("needs /proc to see which ports are open")
    ours = set()
    for descriptor in (folder / "fd").iterdir():
        with contextlib.suppress(OSError):
            ours.add(str(descriptor.readlink()))
    found = set()
    for table in ("net/tcp", "net/tcp6"):
        if (folder / table).exists():
            rows = [line.split() for line in (folder / table).read_text().splitlines()[1:]]
            found |= {row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in ours}
    return found


def open_view(address: str) -> dict[str, str]:
    request = Request(f"http://{address}/api/views", method="POST", headers={"Origin": f"http://{address}"})
    with urlopen(request) as answer:
        view: dict[str, str] = json.load(answer)
    return view


@contextlib.contextmanager
def joined(address: str, path: str, *protocols: str) -> Iterator[ClientConnection]:
    with connect(
        f"ws://{address}{path}",
        origin=Origin(f"http://{address}"),
        subprotocols=[Subprotocol(p) for p in protocols] or None,
        max_size=None,
        proxy=None,
    ) as socket:
        yield socket


def received(socket: ClientConnection, enough: int) -> int:
    """Bytes that came, at least ``enough``; fails after a while."""
    count, deadline = 0, time.monotonic() + 20.0
    while count < enough:
        count += len(socket.recv(timeout=deadline - time.monotonic()))
    return count


def told(socket: ClientConnection, quiet: float = 0.5) -> bytes:
    """What a scene's client is told until nothing comes for so many seconds: the messages, without their arrays."""
    found = b""
    with contextlib.suppress(TimeoutError):
        while True:
            message = socket.recv(timeout=quiet)
            assert isinstance(message, bytes)
            packed = int.from_bytes(message[8:16], "little")
            found += zstandard.ZstdDecompressor().decompress(message[16 : 16 + packed])
    return found


def draw(socket: ClientConnection, step: int, filter_: str = "crossmodal-pf") -> None:
    selection: dict[str, Any] = {"task": "door", "filter": filter_, "episode": 1, "step": step}
    socket.send(json.dumps({"type": "cursor", "serial": step, "angle": None, "size": 41, **selection}))
    assert isinstance(socket.recv(timeout=30.0), bytes)
    assert json.loads(socket.recv(timeout=30.0)) == {"type": "drawn", "serial": step, "step": step}


def test_the_scene_comes_through_our_own_port(address: str) -> None:
    before = listening()
    view = open_view(address)
    with urlopen(f"http://{address}{view['scene']}") as page:
        ours, _, others = page.read().partition(b'<script src="/static/scene/viser_frame_throttle.js"></script>')
    assert b"<script" not in ours
    assert b"<script" in others
    assert b'<div id="root">' in others
    with (
        joined(address, view["socket"]) as page_socket,
        joined(address, view["scene"].rstrip("/"), PROTOCOL) as scene,
    ):
        assert scene.subprotocol == PROTOCOL
        draw(page_socket, 3)
        received(scene, 50_000)  # the robot's meshes
        draw(page_socket, 4)
        received(scene, 1)
        assert listening() == before


def test_two_people_look_at_two_moments_of_two_filters(address: str) -> None:
    with contextlib.ExitStack() as stack:
        views = [open_view(address) for _ in range(2)]
        pages = [stack.enter_context(joined(address, view["socket"])) for view in views]
        scenes = [stack.enter_context(joined(address, v["scene"].rstrip("/"), PROTOCOL)) for v in views]
        draw(pages[0], 3)
        draw(pages[1], 30, "crossmodal-ekf")
        particles, gaussians = map(told, scenes)
        assert b"/particles" in particles
        assert b"/particles" not in gaussians
        assert b"/map" in gaussians
        for mine, other in ((0, 1), (1, 0)):
            pages[mine].send(json.dumps({"type": "look", "hidden": ["estimates"], "ground": "image", "tint": "share"}))
            draw(pages[mine], 20 + mine, ("crossmodal-pf", "crossmodal-ekf")[mine])
            assert b"/map" in told(scenes[mine])
            assert told(scenes[other], quiet=0.2) == b""
            with pytest.raises(TimeoutError):
                pages[other].recv(timeout=0.1)


def test_what_is_hidden_costs_nothing_and_comes_back(address: str) -> None:
    view = open_view(address)
    with joined(address, view["socket"]) as page, joined(address, view["scene"].rstrip("/"), PROTOCOL) as scene:
        draw(page, 3)
        told(scene)
        page.send(json.dumps({"type": "look", "hidden": ["map", "camera"]}))
        hidden = told(scene)
        assert b"/map" in hidden
        assert b"/bodies/frame/" in hidden, "no map is to be seen through the door's frame"
        draw(page, 4)
        moved = told(scene)
        assert b"/particles" in moved
        assert b"/map" not in moved
        assert b"/camera" not in moved
        page.send(json.dumps({"type": "look", "ground": "haptics"}))
        shown = told(scene)
        assert b"/map" in shown
        assert b"/camera" in shown
        page.send(json.dumps({"type": "look", "hidden": ["moon"]}))
        assert "'moon' does not exist" in json.loads(page.recv(timeout=5.0))["error"]


def test_another_version_of_the_client_is_turned_away(address: str) -> None:
    path = open_view(address)["scene"].rstrip("/")
    for protocols in ([], ["viser-v0.0.1"]):
        with contextlib.suppress(Exception), joined(address, path, *protocols) as socket:
            with pytest.raises(ConnectionClosed) as closed:
                socket.recv(timeout=5.0)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1002


def test_a_scenes_browser_has_viser_ask_no_host_and_keep_no_file(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    for name in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(viser.ViserServer, name, lambda _, name=name: asked.append(name))
    monkeypatch.setattr(viser.GuiApi, "_handle_file_transfer_start", lambda *_: asked.append("upload"))
    path = open_view(address)["scene"].rstrip("/")
    upload = {"source_component_uuid": "a", "transfer_uuid": "b", "filename": "c", "mime_type": "d/e"}
    with joined(address, path, PROTOCOL) as scene:
        received(scene, 1)
        for message in (
            {"type": "ShareUrlRequest"},
            {"type": "ShareUrlDisconnect"},
            {"type": "FileTransferStartUpload", "part_count": 10**6, "size_bytes": 10**12, **upload},
        ):
            scene.send(msgspec.msgpack.encode(message))
        scene.send(b"no message of viser's")  # ends the connection once it has taken the others
        with pytest.raises(ConnectionClosed):
            received(scene, 10**9)
    assert asked in ([], ["upload"]), "each connection has a hearing of its own for files, of things that it has not"
    with joined(address, path, PROTOCOL) as again:
        received(again, 1)


def test_a_scene_has_few_browsers(address: str) -> None:
    path = open_view(address)["scene"].rstrip("/")
    with contextlib.ExitStack() as stack:
        scenes = [stack.enter_context(joined(address, path, PROTOCOL)) for _ in range(BROWSERS + 1)]
        with pytest.raises(ConnectionClosed):
            received(scenes[0], 10**9)
        for scene in scenes[1:]:
            received(scene, 1)
            scene.ping().wait(5.0)


def test_a_scene_leaves_no_thread_and_no_connection_behind(address: str) -> None:
    threads = set(threading.enumerate())
    embedded = EmbeddedViser()
    embedded.server.gui.add_slider("a", 0, 1, 1, 0)
    assert set(threading.enumerate()) - threads
    embedded.close()
    deadline = time.monotonic() + 5.0
    while set(threading.enumerate()) - threads:
        assert time.monotonic() < deadline, set(threading.enumerate()) - threads
        time.sleep(0.01)


def test_the_servers_own_views_end_with_it(address: str) -> None:
    for _ in range(2):
        view = open_view(address)
        with joined(address, view["socket"]) as socket, joined(address, view["scene"].rstrip("/"), PROTOCOL) as scene:
            draw(socket, 1)
            received(scene, 1)
    # The fixture ends the server and sees its thread go, connections of viser's included.


def test_viser_must_be_as_it_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other(viser.infra.WebsockServer):
        __module__ = "somewhere.else"

    monkeypatch.setattr(viser.infra, "WebsockServer", Other)
    with pytest.raises(RuntimeError, match=r"written for viser 1\.1"):
        EmbeddedViser()


def test_only_viser_is_kept_from_listening() -> None:
    before = websockets.asyncio.server.serve
    EmbeddedViser().close()
    assert websockets.asyncio.server.serve is before


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.mark.anyio
async def test_views_are_bounded_and_the_idle_ones_go(settings: Settings) -> None:
    from beliefscope.app.runs.trace_store import Library
    from beliefscope.datasets.errors import BadInput

    views = Views(Library(settings), limit=2)
    first, second = await views.open(dark=False), await views.open(dark=True)
    first.idle_since = None  # a page is there
    third = await views.open(dark=False)
    assert len(views) == 2
    assert views[first.name] is first
    with pytest.raises(KeyError):
        views[second.name]
    third.idle_since = None
    with pytest.raises(BadInput, match="at a time, 2;"):
        await views.open(dark=False)
    await views.close()
    assert len(views) == 0


def test_pages_that_come_at_once_are_no_more_than_there_may_be(settings: Settings) -> None:
    from beliefscope.app.runs.trace_store import Library

    async def scenario() -> None:
        views = Views(Library(settings), limit=2)
        opened = [views.open(dark=False) for _ in range(6)]
        tidying = [views._close_idle(keep=0) for _ in range(2)]
        found = await asyncio.gather(*opened, *tidying, return_exceptions=True)
        assert not [one for one in found if isinstance(one, Exception)]
        assert len(views) <= 2
        await views.close()

    asyncio.run(scenario())

"""viser behind the server's port: proxied sockets, no open port, complete shutdown."""

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

from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.views.embedded_viser import MAX_CLIENTS, EmbeddedViser, client_page
from beliefscope.app.views.registry import Views
from beliefscope.datasets.errors import BadInput

pytestmark = pytest.mark.slow

PROTOCOL = f"viser-v{viser.__version__}"


def listening() -> set[str]:
    """Addresses on which this process is listening."""
    folder = Path("/proc/self")
    if not (folder / "net/tcp").exists():
        pytest.skip("requires /proc to list open ports")
    sockets = set()
    for descriptor in (folder / "fd").iterdir():
        with contextlib.suppress(OSError):
            sockets.add(str(descriptor.readlink()))
    addresses = set()
    for table in ("net/tcp", "net/tcp6"):
        if (folder / table).exists():
            rows = [line.split() for line in (folder / table).read_text().splitlines()[1:]]
            addresses |= {row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in sockets}
    return addresses


def open_view(address: str) -> dict[str, str]:
    request = Request(f"http://{address}/api/views", method="POST", headers={"Origin": f"http://{address}"})
    with urlopen(request) as response:
        view: dict[str, str] = json.load(response)
    return view


@contextlib.contextmanager
def connection(address: str, path: str, *protocols: str) -> Iterator[ClientConnection]:
    with connect(
        f"ws://{address}{path}",
        origin=Origin(f"http://{address}"),
        subprotocols=[Subprotocol(p) for p in protocols] or None,
        max_size=None,
        proxy=None,
    ) as socket:
        yield socket


def receive_bytes(socket: ClientConnection, minimum: int) -> int:
    """Receive at least ``minimum`` bytes and return their number; fail after 20 s."""
    count, deadline = 0, time.monotonic() + 20.0
    while count < minimum:
        count += len(socket.recv(timeout=deadline - time.monotonic()))
    return count


def receive_messages(socket: ClientConnection, quiet: float = 0.5) -> bytes:
    """Receive messages of a scene, without their arrays, until there is none for ``quiet`` s."""
    messages = b""
    with contextlib.suppress(TimeoutError):
        while True:
            message = socket.recv(timeout=quiet)
            assert isinstance(message, bytes)
            packed = int.from_bytes(message[8:16], "little")
            messages += zstandard.ZstdDecompressor().decompress(message[16 : 16 + packed])
    return messages


def draw(socket: ClientConnection, step: int, filter_: str = "crossmodal-pf") -> None:
    selection: dict[str, Any] = {"task": "door", "filter": filter_, "episode": 1, "step": step}
    socket.send(json.dumps({"type": "cursor", "serial": step, "angle": None, "size": 41, **selection}))
    assert isinstance(socket.recv(timeout=30.0), bytes)
    assert json.loads(socket.recv(timeout=30.0)) == {"type": "drawn", "serial": step, "step": step}


def test_the_scene_uses_the_servers_port(address: str) -> None:
    before = listening()
    view = open_view(address)
    with urlopen(f"http://{address}{view['scene']}") as page:
        head, _, rest = page.read().partition(b'<script src="/static/scene/viser_frame_throttle.js"></script>')
    assert b"<script" not in head
    assert b"<script" in rest
    assert b'<div id="root">' in rest
    with (
        connection(address, view["socket"]) as page_socket,
        connection(address, view["scene"].rstrip("/"), PROTOCOL) as scene,
    ):
        assert scene.subprotocol == PROTOCOL
        draw(page_socket, 3)
        receive_bytes(scene, 50_000)  # the robot's meshes
        draw(page_socket, 4)
        receive_bytes(scene, 1)
        assert listening() == before


def test_views_of_two_pages_are_independent(address: str) -> None:
    with contextlib.ExitStack() as stack:
        views = [open_view(address) for _ in range(2)]
        pages = [stack.enter_context(connection(address, view["socket"])) for view in views]
        scenes = [stack.enter_context(connection(address, v["scene"].rstrip("/"), PROTOCOL)) for v in views]
        draw(pages[0], 3)
        draw(pages[1], 30, "crossmodal-ekf")
        particles, gaussians = map(receive_messages, scenes)
        assert b"/particles" in particles
        assert b"/particles" not in gaussians
        assert b"/map" in gaussians
        for first, second in ((0, 1), (1, 0)):
            layers = {"type": "scene_layers", "hidden": ["estimates"], "ground": "image", "tint": "share"}
            pages[first].send(json.dumps(layers))
            draw(pages[first], 20 + first, ("crossmodal-pf", "crossmodal-ekf")[first])
            assert b"/map" in receive_messages(scenes[first])
            assert receive_messages(scenes[second], quiet=0.2) == b""
            with pytest.raises(TimeoutError):
                pages[second].recv(timeout=0.1)


def test_hidden_layers_are_not_sent_until_shown_again(address: str) -> None:
    view = open_view(address)
    with connection(address, view["socket"]) as page, connection(address, view["scene"].rstrip("/"), PROTOCOL) as scene:
        draw(page, 3)
        receive_messages(scene)
        page.send(json.dumps({"type": "scene_layers", "hidden": ["map", "camera"]}))
        hidden = receive_messages(scene)
        assert b"/map" in hidden
        assert b"/bodies/frame/" in hidden, "the frame is opaque again"
        draw(page, 4)
        moved = receive_messages(scene)
        assert b"/particles" in moved
        assert b"/map" not in moved
        assert b"/camera" not in moved
        page.send(json.dumps({"type": "scene_layers", "ground": "haptics"}))
        messages = receive_messages(scene)
        assert b"/map" in messages
        assert b"/camera" in messages
        page.send(json.dumps({"type": "scene_layers", "hidden": ["moon"]}))
        assert "scene_layers.hidden.0" in json.loads(page.recv(timeout=5.0))["error"]


def test_clients_of_other_viser_versions_are_rejected(address: str) -> None:
    path = open_view(address)["scene"].rstrip("/")
    for protocols in ([], ["viser-v0.0.1"]):
        with contextlib.suppress(Exception), connection(address, path, *protocols) as socket:
            with pytest.raises(ConnectionClosed) as closed:
                socket.recv(timeout=5.0)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1002


def test_clients_cannot_share_a_scene_or_upload_files(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    for name in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(viser.ViserServer, name, lambda _, name=name: calls.append(name))
    monkeypatch.setattr(viser.GuiApi, "_handle_file_transfer_start", lambda *_: calls.append("upload"))
    path = open_view(address)["scene"].rstrip("/")
    upload = {"source_component_uuid": "a", "transfer_uuid": "b", "filename": "c", "mime_type": "d/e"}
    with connection(address, path, PROTOCOL) as scene:
        receive_bytes(scene, 1)
        for message in (
            {"type": "ShareUrlRequest"},
            {"type": "ShareUrlDisconnect"},
            {"type": "FileTransferStartUpload", "part_count": 10**6, "size_bytes": 10**12, **upload},
        ):
            scene.send(msgspec.msgpack.encode(message))
        scene.send(b"invalid message")  # ends the connection after the previous messages were processed
        with pytest.raises(ConnectionClosed):
            receive_bytes(scene, 10**9)
    assert calls in ([], ["upload"]), "uploads have a handler per connection, which accepts nothing"
    with connection(address, path, PROTOCOL) as second:
        receive_bytes(second, 1)


def test_the_oldest_client_of_a_scene_is_disconnected(address: str) -> None:
    path = open_view(address)["scene"].rstrip("/")
    with contextlib.ExitStack() as stack:
        scenes = [stack.enter_context(connection(address, path, PROTOCOL)) for _ in range(MAX_CLIENTS + 1)]
        with pytest.raises(ConnectionClosed):
            receive_bytes(scenes[0], 10**9)
        for scene in scenes[1:]:
            receive_bytes(scene, 1)
            scene.ping().wait(5.0)


def test_close_ends_all_threads() -> None:
    threads = set(threading.enumerate())
    embedded = EmbeddedViser()
    embedded.server.gui.add_slider("a", 0, 1, 1, 0)
    assert set(threading.enumerate()) - threads
    embedded.close()
    deadline = time.monotonic() + 5.0
    while set(threading.enumerate()) - threads:
        assert time.monotonic() < deadline, set(threading.enumerate()) - threads
        time.sleep(0.01)


@pytest.mark.long
def test_views_end_with_the_server(address: str) -> None:
    for _ in range(2):
        view = open_view(address)
        with (
            connection(address, view["socket"]) as socket,
            connection(address, view["scene"].rstrip("/"), PROTOCOL) as scene,
        ):
            draw(socket, 1)
            receive_bytes(scene, 1)
    # The fixture stops the server and waits for its thread, which includes all connections.


def test_an_incompatible_viser_version_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other(viser.infra.WebsockServer):
        __module__ = "somewhere.else"

    monkeypatch.setattr(viser.infra, "WebsockServer", Other)
    with pytest.raises(RuntimeError, match=r"written for viser 1\.1"):
        EmbeddedViser()


def test_the_server_function_of_websockets_is_restored() -> None:
    original = websockets.asyncio.server.serve
    EmbeddedViser().close()
    assert websockets.asyncio.server.serve is original


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.mark.long
@pytest.mark.anyio
async def test_idle_views_are_replaced_at_the_limit(settings: Settings) -> None:
    views = Views(TraceStore(settings), limit=2)
    first, second = await views.open(dark=False), await views.open(dark=True)
    first.idle_since = None  # a page is connected
    third = await views.open(dark=False)
    assert len(views) == 2
    assert views[first.name] is first
    with pytest.raises(NotFound):
        views[second.name]
    third.idle_since = None
    with pytest.raises(BadInput, match="maximum number of pages is open, 2"):
        await views.open(dark=False)
    await views.close()
    assert len(views) == 0


@pytest.mark.long
def test_concurrent_requests_do_not_exceed_the_limit(settings: Settings) -> None:
    async def scenario() -> None:
        views = Views(TraceStore(settings), limit=2)
        opening = [views.open(dark=False) for _ in range(6)]
        closing = [views._close_idle(keep=0) for _ in range(2)]
        results = await asyncio.gather(*opening, *closing, return_exceptions=True)
        assert not [result for result in results if isinstance(result, Exception)]
        assert len(views) <= 2
        await views.close()

    asyncio.run(scenario())


def test_frame_has_the_colour_scheme_of_the_page() -> None:
    """Otherwise, browsers draw it on white until viser has its theme."""
    head = client_page().partition(b"<script")[0]
    assert b":root { color-scheme: light dark !important }" in head

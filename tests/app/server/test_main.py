"""Files of the page and of others, and the server as a process: its port, its signals."""

from __future__ import annotations

import posixpath
import re
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import brotli
import pytest
from starlette.requests import Request
from starlette.testclient import TestClient

from beliefscope.app.server.auth import Access
from beliefscope.app.server.main import PAGE, Settings, _listen, serve
from beliefscope.app.server.static_files import PageFiles
from beliefscope.app.server.vendor_files import RerunViewer, installed, without_names
from beliefscope.datasets.errors import BadInput

# A module with a type section, a `name` section and another custom section.
SECTIONS = {"type": b"\x01\x04\x01\x60\x00\x00", "name": b"\x00\x07\x04name\x01\x00", "other": b"\x00\x06\x05other"}
PREAMBLE = b"\0asm\x01\0\0\0"


def test_only_the_names_are_left_out() -> None:
    module = PREAMBLE + SECTIONS["type"] + SECTIONS["name"] + SECTIONS["other"]
    assert without_names(module) == PREAMBLE + SECTIONS["type"] + SECTIONS["other"]
    assert without_names(without_names(module)) == without_names(module)
    with pytest.raises(ValueError, match="Not a WebAssembly"):
        without_names(b"MZ")


def request(encodings: str, **headers: str) -> Request:
    sent = {"accept-encoding": encodings} | headers
    return Request({"type": "http", "headers": [(k.encode(), v.encode()) for k, v in sent.items()]})


def test_reruns_viewer_is_compressed_for_who_can_read_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = RerunViewer(tmp_path)
    module = PREAMBLE + SECTIONS["type"] + SECTIONS["name"]
    monkeypatch.setattr(viewer, "_original", tmp_path / "original")
    (tmp_path / "original").write_bytes(module)
    assert "content-encoding" not in viewer.wasm(request("gzip, br")).headers
    viewer.prepare()
    answer = viewer.wasm(request("gzip, br;q=0.9"))
    assert answer.headers["content-encoding"] == "br"
    assert answer.media_type == "application/wasm"
    assert answer.headers["vary"] == "accept-encoding"
    (compressed,) = tmp_path.glob("*.br")
    assert brotli.decompress(compressed.read_bytes()) == without_names(module)
    assert "content-encoding" not in viewer.wasm(request("gzip")).headers
    assert viewer.wasm(request("br", **{"if-none-match": answer.headers["etag"]})).status_code == 304


def test_the_installed_viewer_is_what_we_take_it_for() -> None:
    widget = (installed("rerun_notebook") / "static" / "widget.js").read_bytes()
    assert b"var WebViewer = class" in widget
    assert b"re_viewer_bg.wasm" in widget
    assert b" = fetch(arg0)" in widget, "by a name for which ours stands: one that sends the cookie"
    assert not re.search(rb"^(?:var|let|const|class|(?:async )?function) fetch\b", widget, re.MULTILINE)


@pytest.mark.parametrize(
    ("path", "kind", "content"),
    [
        ("/", "text/html", b"<html"),
        ("/static/uPlot.iife.js", "text/javascript", b"uPlot"),
        ("/static/uPlot.min.css", "text/css", b".uplot"),
        ("/vendor/rerun/viewer.js", "text/javascript", b"export { WebViewer };"),
        ("/vendor/rerun/viewer.js", "text/javascript", b'{ credentials: "same-origin" }'),
    ],
)
def test_files_come_with_their_type_and_are_revalidated(
    client: TestClient, path: str, kind: str, content: bytes
) -> None:
    answer = client.get(path)
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith(kind)
    assert answer.headers["cache-control"] == "no-cache"
    assert content in answer.content
    if "etag" in answer.headers:
        assert client.get(path, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304


def test_the_page_names_its_modules_by_what_is_in_them(client: TestClient) -> None:
    page = client.get("/").text
    named = re.findall(r'<link rel="modulepreload" href="(/static/[0-9a-f]+/([\w./]+))">', page)
    assert {name for _, name in named} >= {"core/main.js", "data/api.js", "maps/map_values.js"}
    assert len({name for _, name in named}) == len(named)
    for address, name in named:
        answer = client.get(address)
        assert "immutable" in answer.headers["cache-control"]
        assert answer.content == (PAGE / name).read_bytes()
        # Whatever it imports is named too, so that none is found out late.
        imported = re.findall(r"^import .* from '(\.[\w./]+)'", answer.text, re.MULTILINE)
        assert {posixpath.normpath(f"{posixpath.dirname(name)}/{other}") for other in imported} <= {n for _, n in named}
    # The name of another content is not kept: a browser with an old page does not hold on to the new file.
    assert client.get("/static/0123456789ab/core/main.js").headers["cache-control"] == "no-cache"


def test_a_file_that_is_edited_has_another_name(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text('<head><script src="/static/core/main.js"></script></head>')
    (tmp_path / "core").mkdir()
    (tmp_path / "core" / "main.js").write_text("import { a } from '../a.js';")
    (tmp_path / "a.js").write_text("export const a = 1;")
    files = PageFiles(tmp_path)
    before = bytes(files.index(request("br")).body)
    (tmp_path / "a.js").write_text("export const a = 12;")
    after = bytes(files.index(request("br")).body)
    names = [set(re.findall(rb"/static/(\w+)/", page)) for page in (before, after)]
    assert [len(each) for each in names] == [1, 1]
    assert names[0] != names[1]
    assert files.file(request("br"), f"{names[1].pop().decode()}/a.js").body == b"export const a = 12;"


@pytest.mark.parametrize("path", ["/static/../server.py", "/static/..%2fserver.py", "/static/x/..%2f__init__.py"])
def test_files_beside_the_page_are_not_served(client: TestClient, path: str) -> None:
    assert client.get(path).status_code == 404


def test_a_busy_port_is_one_clear_line(settings: Settings) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(BadInput, match=f"Cannot listen on 127.0.0.1 port {port}: Address already in use"):
            serve(settings, port=port)


def test_small_messages_are_not_held_back() -> None:
    # What asyncio looks at before it switches off Nagle's algorithm: without it, a frame waits 40 ms for its scene.
    with _listen("127.0.0.1", 0) as listener:
        assert listener.proto == socket.IPPROTO_TCP


@pytest.mark.parametrize(("host", "port"), [("nowhere.invalid", 8000), ("127.0.0.1", 70000)])
def test_an_impossible_address_is_one_clear_line(settings: Settings, host: str, port: int) -> None:
    with pytest.raises(BadInput, match=f"Cannot listen on {host} port {port}: "):
        serve(settings, host=host, port=port, access=Access("a token of this test"))


def test_a_signal_ends_the_server_in_peace(settings: Settings) -> None:
    """Also without the command; of that, and of other signals, ``test_serve.py``."""
    code = (
        "from pathlib import Path; from beliefscope.app.server.main import Settings, serve; "
        f"data = {{'mine': Path({str(settings.data['mine'])!r})}}; "
        f"serve(Settings(Path({str(settings.workspace)!r}), data=data), port=0)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        url = next(word for word in line.split() if word.startswith("http"))
        with urlopen(f"{url}healthz") as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20.0)
        assert (process.returncode, "Traceback" in errors) == (0, False), errors
    finally:
        process.kill()
        shutil.rmtree(settings.workspace, ignore_errors=True)

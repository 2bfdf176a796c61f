"""Static files, and the server process: port and signals."""

from __future__ import annotations

import asyncio
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

from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.auth import Access
from beliefscope.app.server.main import PAGE, listen, serve
from beliefscope.app.server.static_files import PageFiles
from beliefscope.app.server.vendor_files import viewer_wasm
from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.web_viewer import WebViewer, installed, without_names

pytestmark = pytest.mark.slow

# A module with a type section, a `name` section and another custom section.
SECTIONS = {"type": b"\x01\x04\x01\x60\x00\x00", "name": b"\x00\x07\x04name\x01\x00", "other": b"\x00\x06\x05other"}
PREAMBLE = b"\0asm\x01\0\0\0"


def test_without_names_removes_only_the_name_section() -> None:
    module = PREAMBLE + SECTIONS["type"] + SECTIONS["name"] + SECTIONS["other"]
    assert without_names(module) == PREAMBLE + SECTIONS["type"] + SECTIONS["other"]
    assert without_names(without_names(module)) == without_names(module)
    with pytest.raises(ValueError, match="Not a WebAssembly"):
        without_names(b"MZ")


def request(encodings: str, **headers: str) -> Request:
    values = {"accept-encoding": encodings} | headers
    return Request({"type": "http", "headers": [(k.encode(), v.encode()) for k, v in values.items()]})


def test_rerun_viewer_is_compressed_if_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = WebViewer(tmp_path)
    module = PREAMBLE + SECTIONS["type"] + SECTIONS["name"]
    monkeypatch.setattr(viewer, "_original", tmp_path / "original")
    (tmp_path / "original").write_bytes(module)
    assert "content-encoding" not in viewer_wasm(viewer, request("gzip, br")).headers
    viewer.prepare()
    answer = viewer_wasm(viewer, request("gzip, br;q=0.9"))
    assert answer.headers["content-encoding"] == "br"
    assert answer.media_type == "application/wasm"
    assert answer.headers["vary"] == "accept-encoding"
    (compressed,) = tmp_path.glob("*.br")
    assert brotli.decompress(compressed.read_bytes()) == without_names(module)
    assert "content-encoding" not in viewer_wasm(viewer, request("gzip")).headers
    assert viewer_wasm(viewer, request("br", **{"if-none-match": answer.headers["etag"]})).status_code == 304


def test_installed_viewer_has_the_expected_code() -> None:
    widget = (installed("rerun_notebook") / "static" / "widget.js").read_bytes()
    assert b"var WebViewer = class" in widget
    assert b"re_viewer_bg.wasm" in widget
    assert b" = fetch(arg0)" in widget, "calls our replacement of fetch, which sends the cookie"
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
def test_files_have_type_and_etag(shared_client: TestClient, path: str, kind: str, content: bytes) -> None:
    answer = shared_client.get(path)
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith(kind)
    assert answer.headers["cache-control"] == "no-cache"
    assert content in answer.content
    if "etag" in answer.headers:
        assert shared_client.get(path, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304


def test_page_preloads_modules_at_immutable_addresses(shared_client: TestClient) -> None:
    page = shared_client.get("/").text
    preloads = re.findall(r'<link rel="modulepreload" href="(/static/[0-9a-f]+/([\w./]+))">', page)
    assert {name for _, name in preloads} >= {"core/main.js", "data/api.js", "maps/map_values.js"}
    assert len({name for _, name in preloads}) == len(preloads)
    for address, name in preloads:
        answer = shared_client.get(address)
        assert "immutable" in answer.headers["cache-control"]
        assert answer.content == (PAGE / name).read_bytes()
        # All imported modules are preloaded.
        imported = re.findall(r"^import .* from '(\.[\w./]+)'", answer.text, re.MULTILINE)
        assert {posixpath.normpath(f"{posixpath.dirname(name)}/{other}") for other in imported} <= {
            n for _, n in preloads
        }
    # An outdated address is revalidated, so that browsers do not cache the new content under the old address.
    assert shared_client.get("/static/0123456789ab/core/main.js").headers["cache-control"] == "no-cache"


def test_edited_file_has_a_new_address(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text('<head><script src="/static/core/main.js"></script></head>')
    (tmp_path / "core").mkdir()
    (tmp_path / "core" / "main.js").write_text("import { a } from '../a.js';")
    (tmp_path / "a.js").write_text("export const a = 1;")
    files = PageFiles(tmp_path)
    before = bytes(asyncio.run(files.index(request("br"))).body)
    (tmp_path / "a.js").write_text("export const a = 12;")
    after = bytes(asyncio.run(files.index(request("br"))).body)
    names = [set(re.findall(rb"/static/(\w+)/", page)) for page in (before, after)]
    assert [len(hashes) for hashes in names] == [1, 1]
    assert names[0] != names[1]
    address = f"{names[1].pop().decode()}/a.js"
    assert asyncio.run(files.file(request("br"), address)).body == b"export const a = 12;"
    (tmp_path / "a.js").write_text("export const a = 123;")
    answer = asyncio.run(files.file(request("br"), address))
    assert answer.body == b"export const a = 12;", "a browser would cache the new content under the old address"
    assert "immutable" in answer.headers["cache-control"]
    assert asyncio.run(files.file(request("br"), "a.js")).body == b"export const a = 123;"


def test_unknown_address_is_a_page_for_browsers_and_json_for_programs(shared_client: TestClient) -> None:
    path = "/door/<script>"
    page = shared_client.get(path, headers={"Accept": "text/html,*/*;q=0.8"})
    assert page.status_code == 404
    assert 'href="/"' in page.text
    assert "/door/&lt;script&gt;" in page.text
    assert "<script" not in page.text
    assert "style-src 'unsafe-inline'" in page.headers["content-security-policy"]
    program = shared_client.get(path)
    assert program.status_code == 404
    assert set(program.json()) == {"error"}


@pytest.mark.parametrize("path", ["/static/../server.py", "/static/..%2fserver.py", "/static/x/..%2f__init__.py"])
def test_files_outside_the_page_are_not_served(shared_client: TestClient, path: str) -> None:
    assert shared_client.get(path).status_code == 404


def test_busy_port_is_reported(settings: Settings) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(BadInput, match=f"Cannot listen on 127.0.0.1 port {port}: Address already in use"):
            serve(settings, port=port)


def test_small_messages_are_not_delayed() -> None:
    # asyncio disables Nagle's algorithm only for this protocol.
    with listen("127.0.0.1", 0) as listener:
        assert listener.proto == socket.IPPROTO_TCP


@pytest.mark.parametrize(("host", "port"), [("nowhere.invalid", 8000), ("127.0.0.1", 70000)])
def test_invalid_address_is_reported(settings: Settings, host: str, port: int) -> None:
    with pytest.raises(BadInput, match=f"Cannot listen on {host} port {port}: "):
        serve(settings, host=host, port=port, access=Access("a token of this test"))


@pytest.mark.long  # nine seconds; test_serve_command.py has the same for SIGTERM
def test_sigint_stops_the_server(settings: Settings) -> None:
    """Without the command line; see ``test_serve_command.py`` for other signals."""
    code = (
        "from pathlib import Path; from beliefscope.app.runs.settings import Settings; "
        "from beliefscope.app.server.main import serve; "
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

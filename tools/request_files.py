"""Count the Beliefscope source files that run while the server answers one request.

    python tools/request_files.py [--list]

The requests go to a test client on the sample data. A file counts if one of its functions is called in the server
process, in any thread. If the filter runs in a thread, the count of a trace includes the filter's own files.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app

ROOT = Path(__file__).resolve().parents[1]
ORIGIN = "http://localhost:8000"
CURSOR = {"type": "cursor", "task": "door", "filter": "crossmodal-ekf", "episode": 9, "size": 41}


class CallRecorder:
    """Collects the names of all source files whose functions are called while a block runs."""

    def __init__(self) -> None:
        self._names: set[str] | None = None
        threading.setprofile(self._profile)  # for threads that start from now on
        sys.setprofile(self._profile)

    def _profile(self, frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and self._names is not None:
            self._names.add(frame.f_code.co_filename)

    @contextmanager
    def files(self) -> Iterator[list[str]]:
        """Give a list that holds the repository's files, sorted, once the block has ended."""
        files: list[str] = []
        names: set[str] = set()
        self._names = names
        yield files
        self._names = None
        paths = {Path(name).resolve() for name in names if not name.startswith("<")}
        paths = {path for path in paths if path.is_relative_to(ROOT) and path != Path(__file__).resolve()}
        files += sorted(path.relative_to(ROOT).as_posix() for path in paths if ".venv" not in path.parts)


def wait_for_trace(client: TestClient, url: str) -> None:
    """Poll a trace until it is computed."""
    while (response := client.get(url)).status_code == 202:
        time.sleep(0.05)
    assert response.status_code == 200, response.text


def measure(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield each kind of request with its files."""
    recorder = CallRecorder()
    url = "/api/trace/door/crossmodal-ekf/9"
    for name, subprocess in (("trace, computed in a worker process", True), ("trace, computed in a thread", False)):
        app = create_app(Settings(folder / name), warm=False, subprocess=subprocess)
        app.state.views._timeout = 3600.0  # s, so that idle views are not looked for during a request
        with TestClient(app, base_url=ORIGIN, headers={"Origin": ORIGIN}) as client:
            client.get("/api/catalog")
            if subprocess:
                app.state.store._worker.start()
            with recorder.files() as files:
                wait_for_trace(client, url)
            yield name, files
            if subprocess:
                continue
            with recorder.files() as files:
                wait_for_trace(client, url)
            yield "trace, in memory", files
            view = client.post("/api/views").json()["socket"]
            with client.websocket_connect(f"ws://{ORIGIN.removeprefix('http://')}{view}") as socket:
                for serial, request in enumerate(("first cursor", "next cursor")):
                    cursor = CURSOR | {"serial": serial, "step": 20 + serial, "angle": 0.1 * serial}
                    with recorder.files() as files:
                        socket.send_json(cursor)
                        socket.receive_bytes()
                        assert socket.receive_json()["type"] == "drawn"
                    yield request, files
            with recorder.files() as files:
                response = client.post("/api/finetune/door/crossmodal-ekf", json={"steps": 1})
            assert response.status_code in (200, 201, 202), response.text
            yield "fine-tune start", files


def main() -> None:
    """Print a line for each kind of request."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", action="store_true", help="also print the files")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name, files in measure(Path(folder)):
            print(f"{name}: {len(files)} files")
            if arguments.list:
                print("".join(f"    {file}\n" for file in files), end="")


if __name__ == "__main__":
    main()

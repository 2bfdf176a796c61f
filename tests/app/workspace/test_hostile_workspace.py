"""A workspace with unexpected content: pipes, unusual names, invalid records."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from starlette.testclient import TestClient

from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.app.workspace.json_files import content

pytestmark = pytest.mark.slow

TIMEOUT = 60.0  # s
REPORT = "door-crossmodal-ekf-episode{}-0123abcd"
RECORDS = (
    "kept.json",
    "jobs/0123456789abcdef/job.json",
    "study/study.json",
    "recordings/.about/a.rrd.json",
    f"reports/{REPORT.format(0)}/manifest.json",
    "finetune/0123/run.json",
)
FILES = ("recordings/x.rrd", "live/x.live", f"reports/{REPORT.format(0)}/report.html", "finetune/0123/found.json")
LISTS = ("recordings", "reports", "live", "jobs", "studies", "finetune/door/crossmodal-ekf", "lineage/door", "catalog")

Opens = Callable[..., TestClient]


@pytest.fixture
def workspace(settings: Settings) -> Path:
    """A workspace with an unreadable recording and a folder for each record."""
    for name in (*RECORDS, *FILES):
        (settings.workspace / name).parent.mkdir(parents=True, exist_ok=True)
    (settings.workspace / "recordings" / "a.rrd").write_bytes(b"RRF2 of no run")
    return settings.workspace


@pytest.fixture
def pipes(workspace: Path) -> Iterator[list[Path]]:
    """Named pipes in place of files."""
    paths = [workspace / name for name in (*RECORDS, *FILES)]
    for path in paths:
        os.mkfifo(path)
    yield paths
    for path in paths:  # unblocks any reader
        os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))


def get_all(open_client: Opens, settings: Settings, *paths: str) -> dict[str, Any]:
    """JSON responses of a new server, with status 200."""
    with open_client(settings) as client:
        responses = {path: client.get(f"/api/{path}") for path in paths}
    assert {path: response.status_code for path, response in responses.items()} == dict.fromkeys(paths, 200)
    return {path: response.json() for path, response in responses.items()}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="requires named pipes")
def test_pipes_do_not_block_the_server(pipes: list[Path], settings: Settings, open_client: Opens) -> None:
    with ThreadPoolExecutor(1) as thread:
        responses = thread.submit(get_all, open_client, settings, *LISTS)
        try:
            lists = responses.result(TIMEOUT)
        finally:
            for path in pipes:
                os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))
    assert [file["name"] for file in lists["recordings"]["recordings"]] == ["a.rrd"]
    assert lists["reports"]["reports"] == lists["jobs"] == []
    assert [study["name"] for study in lists["studies"]["studies"]] == ["shipped"]


def test_records_are_regular_files_of_limited_size(workspace: Path) -> None:
    (workspace / "endless").symlink_to("/dev/zero")
    with (workspace / "large").open("wb") as file:
        file.truncate(1 << 40)
    for name in ("endless", "large", "recordings", "missing"):
        with pytest.raises(OSError, match=name):
            content(workspace / name)
    assert content(workspace / "recordings" / "a.rrd") == b"RRF2 of no run"


INVALID: tuple[Any, ...] = ([], "[" * 100_000, "\ud800")


@pytest.mark.first(1)
@pytest.mark.parametrize("invalid", INVALID, ids=["list", "nested", "surrogate"])
def test_invalid_records_are_ignored(workspace: Path, settings: Settings, open_client: Opens, invalid: Any) -> None:
    status = (workspace / "recordings" / "a.rrd").stat()
    about = dict.fromkeys(("application", "title", "entities", "rows", "task", "filter", "faults", "problem"), invalid)
    run = [{"episode": invalid, "faults": invalid}]
    records = {
        "recordings/.about/a.rrd.json": {"bytes": status.st_size, "modified": status.st_mtime_ns, "about": about},
        f"reports/{REPORT.format(0)}/manifest.json": {
            **{"title": invalid, "made": invalid, "task": "door", "filter": invalid},
            **{"traces": run, "files": {}},
        },
        f"reports/{REPORT.format(1)}/manifest.json": invalid,
        "study/study.json": invalid,
        "kept.json": invalid,
    }
    for name, record in records.items():
        path = workspace / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(record if isinstance(record, str) and record.isascii() else json.dumps(record))
    good = workspace / "reports" / REPORT.format(2)
    good.mkdir()
    traces = [{"episode": 2, "faults": []}]
    valid = {"title": "valid", "made": "2026", "task": "door", "filter": "x", "traces": traces, "files": {}}
    (good / "manifest.json").write_text(json.dumps(valid))
    lists = get_all(open_client, settings, *LISTS)
    assert [report["title"] for report in lists["reports"]["reports"]] == ["valid"]
    assert [file["name"] for file in lists["recordings"]["recordings"]] == ["a.rrd"]


def test_files_with_unusual_names_can_be_managed(workspace: Path, settings: Settings, open_client: Opens) -> None:
    names = ("a:b", " a", "a ", "e\u0301", "<img src=x onerror=alert(1)>", "x" * 246)
    for name in names:
        (workspace / "recordings" / f"{name}.rrd").write_bytes(name.encode())
    with open_client(settings) as client:
        urls = {file["name"]: file["url"] for file in client.get("/api/recordings").json()["recordings"]}
        assert urls.keys() == {f"{name}.rrd" for name in (*names, "a")}
        for name in names:
            url = urls[f"{name}.rrd"]
            assert client.get(url).content == name.encode()
            assert client.patch(url, json={"name": "plain"}).json()["name"] == "plain.rrd"
            assert client.delete("/api/recordings/plain.rrd").status_code == 200


def test_unreadable_recordings_are_reported(workspace: Path, settings: Settings, open_client: Opens) -> None:
    (workspace / "recordings" / "a.rrd").chmod(0)
    if os.access(workspace / "recordings" / "a.rrd", os.R_OK):
        pytest.skip("this user may read all files")
    with open_client(settings) as client:
        response = client.get("/api/recordings/a.rrd")
    assert (response.status_code, "Permission denied" in response.json()["error"]) == (400, True)


def test_files_with_unprintable_names_are_ignored(workspace: Path, settings: Settings, open_client: Opens) -> None:
    names = (b"a\nb", b"a\xffb", "a\u2028b".encode(), "a\u202eb".encode(), b"x" * 250)
    for name in names:
        with suppress(OSError):  # the file system rejects the name
            (workspace / "recordings" / os.fsdecode(name + b".rrd")).write_bytes(b"RRF2 more")
    with open_client(settings) as client:
        assert [file["name"] for file in client.get("/api/recordings").json()["recordings"]] == ["a.rrd"]
        for name in names:
            assert client.get(f"/api/recordings/{quote(name)}.rrd").status_code == 404


def test_files_in_place_of_folders_are_reported(settings: Settings, open_client: Opens) -> None:
    run = {"task": "door", "filter": "crossmodal-ekf", "episode": 1}
    with open_client(settings) as client:
        for folder in ("recordings", "reports", "live", "jobs", "finetune", "traces"):
            (settings.workspace / folder).write_text("")
        responses = [client.get(f"/api/{path}") for path in LISTS]
        responses += [
            client.post("/api/recordings", json=run),
            client.post("/api/reports/door/crossmodal-ekf/1"),
            client.post("/api/finetune/door/crossmodal-ekf", json={}),
            client.get("/api/trace/door/crossmodal-ekf/1"),
        ]
    assert {response.status_code for response in responses} <= {200, 201, 202, 400, 404}
    assert any("recordings/.deleted' cannot be used: Not a directory." in response.text for response in responses)


@pytest.mark.parametrize("name", ["../../x", "x/../../../y", "a" * 300, "a\nb", "\u202e<script>", "..", "/etc/x"])
def test_file_names_contain_only_safe_characters(name: str) -> None:
    stem = Selection("door", name, 3).file_stem
    assert stem.startswith("door-")
    assert stem.endswith("-episode3")
    assert len(stem) <= 170
    assert not set(stem) & set("/\\\0\n<>")


def test_links_to_results_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "jobs" / "0123").mkdir(parents=True)
    (tmp_path / "secret").write_text("{}")
    (tmp_path / "jobs" / "0123" / "result.json").symlink_to(tmp_path / "secret")
    jobs = Jobs(tmp_path / "jobs")
    assert jobs.result("0123") is None
    (tmp_path / "jobs" / "0123" / "result.json").unlink()
    assert jobs.result("0123") is None
    (tmp_path / "jobs" / "0123" / "result.json").write_text("{}")
    assert jobs.result("0123")

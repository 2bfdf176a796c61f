"""A workspace into which others have put what no server of ours leaves there: pipes, odd names, wrong records."""

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
from beliefscope.app.server.main import Settings
from beliefscope.app.workspace.json_files import content

PATIENCE = 60.0  # s
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
    """With a recording that Rerun cannot read, as there are some, and a folder for each record."""
    for name in (*RECORDS, *FILES):
        (settings.workspace / name).parent.mkdir(parents=True, exist_ok=True)
    (settings.workspace / "recordings" / "a.rrd").write_bytes(b"RRF2 of no run")
    return settings.workspace


@pytest.fixture
def pipes(workspace: Path) -> Iterator[list[Path]]:
    """In place of files."""
    made = [workspace / name for name in (*RECORDS, *FILES)]
    for path in made:
        os.mkfifo(path)
    yield made
    for path in made:  # whoever waits there all the same goes on
        os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))


def told(open_client: Opens, settings: Settings, *paths: str) -> dict[str, Any]:
    """What a new server answers, each 200."""
    with open_client(settings) as client:
        answers = {path: client.get(f"/api/{path}") for path in paths}
    assert {path: answer.status_code for path, answer in answers.items()} == dict.fromkeys(paths, 200)
    return {path: answer.json() for path, answer in answers.items()}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_nobody_waits_at_a_pipe(pipes: list[Path], settings: Settings, open_client: Opens) -> None:
    with ThreadPoolExecutor(1) as thread:
        asked = thread.submit(told, open_client, settings, *LISTS)
        try:
            found = asked.result(PATIENCE)
        finally:
            for path in pipes:
                os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))
    assert [one["name"] for one in found["recordings"]["recordings"]] == ["a.rrd"]
    assert found["reports"]["reports"] == found["jobs"] == []
    assert [one["name"] for one in found["studies"]["studies"]] == ["shipped"]


def test_a_record_is_a_plain_file_of_a_size_that_can_be(workspace: Path) -> None:
    (workspace / "endless").symlink_to("/dev/zero")
    with (workspace / "large").open("wb") as file:
        file.truncate(1 << 40)
    for name in ("endless", "large", "recordings", "missing"):
        with pytest.raises(OSError, match=name):
            content(workspace / name)
    assert content(workspace / "recordings" / "a.rrd") == b"RRF2 of no run"


WRONG: tuple[Any, ...] = ([], "[" * 100_000, "\ud800")


@pytest.mark.parametrize("wrong", WRONG, ids=["a list", "deep", "half a letter"])
def test_a_record_that_makes_no_sense_is_none(
    workspace: Path, settings: Settings, open_client: Opens, wrong: Any
) -> None:
    status = (workspace / "recordings" / "a.rrd").stat()
    about = dict.fromkeys(("application", "title", "entities", "rows", "task", "filter", "faults", "problem"), wrong)
    run = [{"episode": wrong, "faults": wrong}]
    records = {
        "recordings/.about/a.rrd.json": {"bytes": status.st_size, "modified": status.st_mtime_ns, "about": about},
        f"reports/{REPORT.format(0)}/manifest.json": {
            **{"title": wrong, "made": wrong, "task": "door", "filter": wrong},
            **{"traces": run, "files": {}},
        },
        f"reports/{REPORT.format(1)}/manifest.json": wrong,
        "study/study.json": wrong,
        "kept.json": wrong,
    }
    for name, said in records.items():
        path = workspace / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(said if isinstance(said, str) and said.isascii() else json.dumps(said))
    good = workspace / "reports" / REPORT.format(2)
    good.mkdir()
    traces = [{"episode": 2, "faults": []}]
    fine = {"title": "fine", "made": "2026", "task": "door", "filter": "x", "traces": traces, "files": {}}
    (good / "manifest.json").write_text(json.dumps(fine))
    found = told(open_client, settings, *LISTS)
    assert [one["title"] for one in found["reports"]["reports"]] == ["fine"]
    assert [one["name"] for one in found["recordings"]["recordings"]] == ["a.rrd"]


def test_a_file_of_any_name_that_can_be_read_is_looked_after(
    workspace: Path, settings: Settings, open_client: Opens
) -> None:
    names = ("a:b", " a", "a ", "e\u0301", "<img src=x onerror=alert(1)>", "x" * 246)
    for name in names:
        (workspace / "recordings" / f"{name}.rrd").write_bytes(name.encode())
    with open_client(settings) as client:
        found = {one["name"]: one["url"] for one in client.get("/api/recordings").json()["recordings"]}
        assert found.keys() == {f"{name}.rrd" for name in (*names, "a")}
        for name in names:
            url = found[f"{name}.rrd"]
            assert client.get(url).content == name.encode()
            assert client.patch(url, json={"tags": ["odd"]}).json()["tags"] == ["odd"]
            assert client.patch(url, json={"name": "plain"}).json()["tags"] == ["odd"]
            assert client.delete("/api/recordings/plain.rrd").status_code == 200


def test_a_recording_that_nobody_may_read_is_said(workspace: Path, settings: Settings, open_client: Opens) -> None:
    (workspace / "recordings" / "a.rrd").chmod(0)
    if os.access(workspace / "recordings" / "a.rrd", os.R_OK):
        pytest.skip("this user may read everything")
    with open_client(settings) as client:
        answer = client.get("/api/recordings/a.rrd")
    assert (answer.status_code, "Permission denied" in answer.json()["error"]) == (400, True)


def test_a_file_of_another_name_is_none(workspace: Path, settings: Settings, open_client: Opens) -> None:
    names = (b"a\nb", b"a\xffb", "a\u2028b".encode(), "a\u202eb".encode(), b"x" * 250)
    for name in names:
        with suppress(OSError):  # a disk that takes no such name
            (workspace / "recordings" / os.fsdecode(name + b".rrd")).write_bytes(b"RRF2 more")
    with open_client(settings) as client:
        assert [one["name"] for one in client.get("/api/recordings").json()["recordings"]] == ["a.rrd"]
        for name in names:
            assert client.get(f"/api/recordings/{quote(name)}.rrd").status_code == 404


def test_a_file_in_place_of_a_folder_is_said(settings: Settings, open_client: Opens) -> None:
    run = {"task": "door", "filter": "crossmodal-ekf", "episode": 1}
    with open_client(settings) as client:
        for folder in ("recordings", "reports", "live", "jobs", "finetune", "traces"):
            (settings.workspace / folder).write_text("")
        asked = [client.get(f"/api/{path}") for path in LISTS]
        asked += [
            client.post("/api/recordings", json=run),
            client.post("/api/reports/door/crossmodal-ekf/1"),
            client.post("/api/finetune/door/crossmodal-ekf", json={}),
            client.get("/api/trace/door/crossmodal-ekf/1"),
        ]
    assert {answer.status_code for answer in asked} <= {200, 201, 202, 400, 404}, [answer.text for answer in asked]
    assert any("recordings' cannot be used: Not a directory." in answer.text for answer in asked)


@pytest.mark.parametrize("name", ["../../x", "x/../../../y", "a" * 300, "a\nb", "\u202e<script>", "..", "/etc/x"])
def test_files_of_a_run_are_named_by_letters_whatever_its_filter_is_called(name: str) -> None:
    stem = Selection("door", name, 3).stem
    assert stem.startswith("door-")
    assert stem.endswith("-episode3")
    assert len(stem) <= 170
    assert not set(stem) & set("/\\\0\n<>")


def test_a_result_that_leads_elsewhere_is_none(tmp_path: Path) -> None:
    (tmp_path / "jobs" / "0123").mkdir(parents=True)
    (tmp_path / "secret").write_text("{}")
    (tmp_path / "jobs" / "0123" / "result.json").symlink_to(tmp_path / "secret")
    jobs = Jobs(tmp_path / "jobs")
    assert jobs.result("0123") is None
    (tmp_path / "jobs" / "0123" / "result.json").unlink()
    assert jobs.result("0123") is None
    (tmp_path / "jobs" / "0123" / "result.json").write_text("{}")
    assert jobs.result("0123")

"""The server's log: one line an event, as text and as JSON, that nobody else can write into or fill."""

from __future__ import annotations

import io
import json
import logging
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.server import logs
from beliefscope.app.server.logs import MAX_REFUSALS, RefusalLimit

log = logging.getLogger("beliefscope.app")


@pytest.fixture
def written(request: pytest.FixtureRequest) -> Iterator[io.StringIO]:
    """What is logged, in the form that the test names."""
    names = ("beliefscope", "uvicorn.error")
    before = [(logger.handlers, logger.level) for logger in map(logging.getLogger, names)]
    stream = io.StringIO()
    logs.configure("info", request.param, stream=stream)
    yield stream
    for name, (handlers, level) in zip(names, before, strict=True):
        logging.getLogger(name).handlers = handlers
        logging.getLogger(name).setLevel(level)


@pytest.mark.parametrize("written", ["json"], indirect=True)
def test_json_is_an_object_a_line(written: io.StringIO) -> None:
    log.info("job ended", extra={"event": {"job": "0123", "seconds": 1.5}})
    log.debug("not at this level")
    try:
        raise ValueError("of three\nlines\nof text")
    except ValueError:
        log.exception("failed")
    ended, failed = map(json.loads, written.getvalue().splitlines())
    assert ended.pop("time").endswith("Z")
    assert ended == {"level": "info", "event": "job ended", "job": "0123", "seconds": 1.5}
    assert failed["traceback"].splitlines()[0].startswith("Traceback")


@pytest.mark.parametrize("written", ["text"], indirect=True)
def test_text_has_the_same(written: io.StringIO) -> None:
    log.warning("job ended", extra={"event": {"job": "0123", "error": "no room"}})
    (line,) = written.getvalue().splitlines()
    assert line.split(" ", 1)[1] == 'warning: job ended job="0123" error="no room"'


@pytest.mark.parametrize("written", logs.FORMATS, indirect=True)
def test_a_log_line_cannot_be_forged(written: io.StringIO, client: TestClient) -> None:
    forged = "x\r\n2026-01-01T00:00:00.000Z error: all is lost\u2028\x1b[2J\x9b2J"
    client.get("/api/jobs", headers={"Host": forged.encode()})  # type: ignore[dict-item]
    client.get("/api/%0a2026-01-01 error: all is lost", headers={"Host": "evil.example"})
    client.post("/api/views", headers={"Origin": forged.encode("latin-1", errors="ignore")})  # type: ignore[dict-item]
    log.warning("%s", forged, extra={"event": {"name": forged}})
    lines = written.getvalue().splitlines()
    assert len(lines) == 4
    try:
        raise ValueError(forged)
    except ValueError:
        log.exception("failed")
    lines = written.getvalue().splitlines()
    assert not [line for line in lines if line.startswith("2026-01-01")]
    assert all(line.isprintable() for line in lines), "a terminal obeys none of it"


@pytest.mark.parametrize("written", ["json"], indirect=True)
def test_what_is_refused_is_told_with_its_reason(written: io.StringIO, client: TestClient) -> None:
    client.get("/api/catalog?task=secret", headers={"Host": "evil.example"})
    client.get("/api/jobs/missing")
    (line,) = map(json.loads, written.getvalue().splitlines())
    assert line["level"] == "warning"
    assert line["event"].startswith("refused: Host 'evil.example'")
    assert (line["status"], line["path"]) == (403, "/api/catalog")


def test_refusals_do_not_fill_the_log() -> None:
    now = [0.0]
    enough = RefusalLimit(clock=lambda: now[0])

    def record(text: str) -> logging.LogRecord:
        return logging.LogRecord("beliefscope.app", logging.WARNING, "", 0, text, None, None)

    lines = ("refused: no", "Invalid HTTP request received.")  # the second is uvicorn's
    assert sum(enough.filter(record(lines[i % 2])) for i in range(10 * MAX_REFUSALS)) == MAX_REFUSALS
    assert enough.filter(record("job ended"))
    now[0] = 61.0
    after = record("refused: no")
    assert enough.filter(after)
    assert after.event["left_out_before"] == 9 * MAX_REFUSALS  # type: ignore[attr-defined]


@pytest.mark.parametrize("written", ["json"], indirect=True)
def test_a_job_is_told_of_when_it_begins_and_ends(
    written: io.StringIO, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "jobs"))
    jobs = Jobs(tmp_path / "jobs", {"crash": "job_functions:crash"})
    job = jobs.submit("crash", "Dividing", {"numbers": []}, "key")
    end = time.monotonic() + 60.0
    while jobs[job.id].ended is None:
        assert time.monotonic() < end
        time.sleep(0.05)
    jobs.close()
    began, ended = map(json.loads, written.getvalue().splitlines())
    assert (began["event"], began["job"], began["title"]) == ("job began", job.id, "Dividing")
    assert (ended["event"], ended["job"], ended["level"]) == ("job ended", job.id, "warning")
    assert "ZeroDivisionError" in ended["error"]
    assert ended["seconds"] >= 0.0

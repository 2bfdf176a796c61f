"""The server's log: formats, escaping and limits."""

from __future__ import annotations

import io
import json
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.server import logs
from beliefscope.app.server.logs import MAX_REFUSALS, RefusalLimit

pytestmark = pytest.mark.slow

log = logging.getLogger("beliefscope.app")


@pytest.fixture
def log_text(request: pytest.FixtureRequest) -> Iterator[io.StringIO]:
    """The log, in the format given as parameter."""
    names = ("beliefscope", "uvicorn.error")
    before = [(logger.handlers, logger.level) for logger in map(logging.getLogger, names)]
    stream = io.StringIO()
    logs.configure("info", request.param, stream=stream)
    yield stream
    for name, (handlers, level) in zip(names, before, strict=True):
        logging.getLogger(name).handlers = handlers
        logging.getLogger(name).setLevel(level)


@pytest.mark.parametrize("log_text", ["json"], indirect=True)
def test_json_format(log_text: io.StringIO) -> None:
    log.info("job ended", extra={"event": {"job": "0123", "seconds": 1.5}})
    log.debug("not at this level")
    try:
        raise ValueError("of three\nlines\nof text")
    except ValueError:
        log.exception("failed")
    ended, failed = map(json.loads, log_text.getvalue().splitlines())
    assert ended.pop("time").endswith("Z")
    assert ended == {"level": "info", "event": "job ended", "job": "0123", "seconds": 1.5}
    assert failed["traceback"].splitlines()[0].startswith("Traceback")


@pytest.mark.parametrize("log_text", ["text"], indirect=True)
def test_text_format(log_text: io.StringIO) -> None:
    log.warning("job ended", extra={"event": {"job": "0123", "error": "no room"}})
    (line,) = log_text.getvalue().splitlines()
    assert line.split(" ", 1)[1] == 'warning: job ended job="0123" error="no room"'


@pytest.mark.parametrize("log_text", ["text", "json"], indirect=True)
def test_log_lines_cannot_be_forged(log_text: io.StringIO, client: TestClient) -> None:
    forged = "x\r\n2026-01-01T00:00:00.000Z error: injected line\u2028\x1b[2J\x9b2J"
    client.get("/api/jobs", headers={"Host": forged.encode()})  # type: ignore[dict-item]
    client.get("/api/%0a2026-01-01 error: injected line", headers={"Host": "evil.example"})
    client.post("/api/views", headers={"Origin": forged.encode("latin-1", errors="ignore")})  # type: ignore[dict-item]
    log.warning("%s", forged, extra={"event": {"name": forged}})
    lines = log_text.getvalue().splitlines()
    assert len(lines) == 4
    try:
        raise ValueError(forged)
    except ValueError:
        log.exception("failed")
    lines = log_text.getvalue().splitlines()
    assert not [line for line in lines if line.startswith("2026-01-01")]
    assert all(line.isprintable() for line in lines), "control characters are escaped"


@pytest.mark.parametrize("log_text", ["json"], indirect=True)
def test_refusal_is_logged_with_reason(log_text: io.StringIO, client: TestClient) -> None:
    client.get("/api/catalog?task=secret", headers={"Host": "evil.example"})
    client.get("/api/jobs/missing")
    (line,) = map(json.loads, log_text.getvalue().splitlines())
    assert line["level"] == "warning"
    assert line["event"].startswith("refused: Host 'evil.example'")
    assert (line["status"], line["path"]) == (403, "/api/catalog")


def test_number_of_logged_refusals_is_limited() -> None:
    now = [0.0]
    limit = RefusalLimit(clock=lambda: now[0])

    def record(text: str) -> logging.LogRecord:
        return logging.LogRecord("beliefscope.app", logging.WARNING, "", 0, text, None, None)

    lines = ("refused: no", "Invalid HTTP request received.")  # the second is uvicorn's
    assert sum(limit.filter(record(lines[i % 2])) for i in range(10 * MAX_REFUSALS)) == MAX_REFUSALS
    assert limit.filter(record("job ended"))
    now[0] = 61.0
    after = record("refused: no")
    assert limit.filter(after)
    assert after.event["omitted_before"] == 9 * MAX_REFUSALS  # type: ignore[attr-defined]


@pytest.mark.parametrize("log_text", ["json"], indirect=True)
def test_start_and_end_of_jobs_are_logged(
    log_text: io.StringIO, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "jobs"), prepend=os.pathsep)
    jobs = Jobs(tmp_path / "jobs", {"crash": "job_functions:crash"})
    job = jobs.submit("crash", "Dividing", {"numbers": []}, "key")
    end = time.monotonic() + 60.0
    while jobs[job.id].ended is None:
        assert time.monotonic() < end
        time.sleep(0.05)
    jobs.close()
    started, ended = map(json.loads, log_text.getvalue().splitlines())
    assert (started["event"], started["job"], started["title"]) == ("job started", job.id, "Dividing")
    assert (ended["event"], ended["job"], ended["level"]) == ("job ended", job.id, "warning")
    assert "ZeroDivisionError" in ended["error"]
    assert ended["seconds"] >= 0.0

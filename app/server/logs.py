"""The server's log on standard error: one line per event, as text or JSON, without secrets.

``extra={"event": {...}}`` adds named values to a line. Levels: ``info`` for normal events, ``warning`` for refused
requests and failed jobs, ``error`` for server errors, with an id that the response contains, too.
"""

import json
import logging
import re
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, TextIO

SECRET = re.compile(r"((?:\btoken=|[Bb]earer |beliefscope-\d+=))[^\s&;\"']+")
MAX_REFUSALS = 30  # logged per minute, so that refused requests do not fill the disk
REFUSALS = ("refused: ", "Invalid HTTP request", "Unsupported upgrade")
"""Beginnings of log messages about refused requests; the latter two are uvicorn's."""


class LineFormatter(logging.Formatter):
    """Formats one line per event.

    json_lines: JSON objects ``{"time", "level", "event", ...}`` instead of text. secret: replaced by ``...``.
    """

    def __init__(self, json_lines: bool, secret: str = "") -> None:
        super().__init__()
        self._json_lines = json_lines
        self._secrets = {secret, json.dumps(secret)[1:-1]} - {""}

    def format(self, record: logging.LogRecord) -> str:
        when = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        values: dict[str, Any] = {"event": record.getMessage(), **getattr(record, "event", {})}
        if record.exc_info:
            values["traceback"] = self.formatException(record.exc_info)
        if self._json_lines:
            line = json.dumps({"time": when, "level": record.levelname.lower(), **values}, default=str)
        else:
            event, traceback = values.pop("event"), values.pop("traceback", "")
            # JSON encoding prevents external values from starting a new line.
            pairs = "".join(f" {key}={json.dumps(value, default=str)}" for key, value in values.items())
            line = f"{when} {record.levelname.lower()}: {_escape(' '.join(event.split()))}{pairs}"
            line += "".join(f"\n  {_escape(each)}" for each in traceback.splitlines())
        for secret in self._secrets:
            line = line.replace(secret, "...")
        return SECRET.sub(r"\1...", line)


def _escape(text: str) -> str:
    """Escape terminal control characters."""
    return "".join(character if character.isprintable() else repr(character)[1:-1] for character in text)


class RefusalLimit(logging.Filter):
    """Limits messages about refused requests per minute; the next one logged contains the number of omitted ones."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock, self._start, self._count = clock, clock(), 0

    def filter(self, record: logging.LogRecord) -> bool:
        if not record.getMessage().startswith(REFUSALS):
            return True
        if self._clock() - self._start >= 60.0:
            omitted, self._start, self._count = self._count - MAX_REFUSALS, self._clock(), 0
            if omitted > 0:
                record.event = {**getattr(record, "event", {}), "omitted_before": omitted}
        self._count += 1
        return self._count <= MAX_REFUSALS


def configure(level: str = "warning", form: str = "text", secret: str = "", stream: TextIO | None = None) -> None:
    """Send the server's log to ``stream``, by default standard error."""
    handler = logging.StreamHandler(stream)
    handler.setFormatter(LineFormatter(form == "json", secret))
    handler.addFilter(RefusalLimit())
    for name in ("beliefscope", "uvicorn.error"):
        logger = logging.getLogger(name)
        logger.handlers = [handler]
        logger.setLevel(level.upper())
    # uvicorn's info lines contain the addresses of views, which are secret.
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)


def is_relevant(record: logging.LogRecord) -> bool:
    """Filter for two messages of uvicorn: a WebSocket refused with a response, and errors that the guard logs."""
    message = record.getMessage()
    return not message.startswith(
        ("ASGI callable returned without completing handshake", "Exception in ASGI application")
    )

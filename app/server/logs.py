"""What the server tells of its work on standard error: one line an event, as text or JSON, without secrets.

Modules log through ``logging`` as ever; ``extra={"event": {...}}`` adds named values to a line. Levels: ``info`` is
what went well (the server started, a job ended), ``warning`` what was refused or could not be done, ``error`` what
failed for no fault of the user's, with a mark that the answer to the browser names too.
"""

from __future__ import annotations

import json
import logging
import re
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, TextIO

LEVELS = ("debug", "info", "warning", "error")
FORMATS = ("text", "json")
SECRET = re.compile(r"((?:\btoken=|[Bb]earer |beliefscope-\d+=))[^\s&;\"']+")
REFUSED = 30  # lines a minute; whoever asks in vain fills no disk
REFUSALS = ("refused: ", "Invalid HTTP request", "Unsupported upgrade")
"""What such a line begins with; the others are uvicorn's."""


class Lines(logging.Formatter):
    """One line an event.

    Args:
        json_lines: JSON objects ``{"time", "level", "event", ...}``; else text. secret: shown as ``...``.
    """

    def __init__(self, json_lines: bool, secret: str = "") -> None:
        super().__init__()
        self._json_lines = json_lines
        self._secrets = {secret, json.dumps(secret)[1:-1]} - {""}

    def format(self, record: logging.LogRecord) -> str:
        when = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        said: dict[str, Any] = {"event": record.getMessage(), **getattr(record, "event", {})}
        if record.exc_info:
            said["traceback"] = self.formatException(record.exc_info)
        if self._json_lines:
            line = json.dumps({"time": when, "level": record.levelname.lower(), **said}, default=str)
        else:
            event, traceback = said.pop("event"), said.pop("traceback", "")
            # As JSON, what comes from outside cannot end the line and begin another one.
            values = "".join(f" {key}={json.dumps(value, default=str)}" for key, value in said.items())
            line = f"{when} {record.levelname.lower()}: {_inert(' '.join(event.split()))}{values}"
            line += "".join(f"\n  {_inert(each)}" for each in traceback.splitlines())
        return self._without_secrets(line)

    def _without_secrets(self, line: str) -> str:
        for secret in self._secrets:
            line = line.replace(secret, "...")
        return SECRET.sub(r"\1...", line)


def _inert(text: str) -> str:
    """Without what a terminal would obey."""
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in text)


class Enough(logging.Filter):
    """Lets through so many refusals a minute, and says how many were left out."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock, self._since, self._count = clock, clock(), 0

    def filter(self, record: logging.LogRecord) -> bool:
        if not record.getMessage().startswith(REFUSALS):
            return True
        if self._clock() - self._since >= 60.0:
            left_out, self._since, self._count = self._count - REFUSED, self._clock(), 0
            if left_out > 0:
                record.event = {**getattr(record, "event", {}), "left_out_before": left_out}
        self._count += 1
        return self._count <= REFUSED


class _StandardError(logging.StreamHandler[TextIO]):
    """Writes to what is standard error at the time."""

    @property
    def stream(self) -> TextIO:
        return sys.stderr

    @stream.setter
    def stream(self, _: TextIO) -> None:
        pass


def begin(level: str = "warning", form: str = "text", secret: str = "", stream: TextIO | None = None) -> None:
    """From now on the server's log goes to ``stream``, standard error if None."""
    handler = _StandardError() if stream is None else logging.StreamHandler(stream)
    handler.setFormatter(Lines(form == "json", secret))
    handler.addFilter(Enough())
    for name in ("beliefscope", "uvicorn.error"):
        logger = logging.getLogger(name)
        logger.handlers = [handler]
        logger.setLevel(level.upper())
    # uvicorn's own lines are of each connection, with addresses that open views.
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)


def no_false_alarm(record: logging.LogRecord) -> bool:
    """Without two lines of uvicorn's: of a WebSocket that was refused with an answer, and of what the guard logs."""
    said = record.getMessage()
    return not said.startswith(("ASGI callable returned without completing handshake", "Exception in ASGI application"))

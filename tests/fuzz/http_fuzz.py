"""Wrong requests to the server: from its own OpenAPI description over HTTP, and messages of any shape to a view."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mutate
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode
from starlette.testclient import TestClient, WebSocketTestSession

from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.runs.trace_store import Settings
from beliefscope.app.server.main import create_app
from beliefscope.datasets.faults.injection import FAULT_PRESETS
from beliefscope.filters.finetuning.finetune import FineTune
from beliefscope.inspect.catalog import DIAGNOSTICS

ORIGIN = "http://localhost:8000"


@dataclass
class Tally:
    """How many were sent, how they were answered, and what went wrong: what -> an input that shows it."""

    inputs: int = 0
    answers: Counter[str] = field(default_factory=Counter)
    failures: dict[str, str] = field(default_factory=dict)


class Heard(logging.Handler):
    """What the server logs as an error."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.records: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(f"{record.getMessage()}: {record.exc_info and record.exc_info[1]!r}")


@contextmanager
def served(given_: Settings) -> Iterator[tuple[TestClient, Heard]]:
    """A server in this process, whose jobs wait and never run: what they are asked for is what is tried here."""
    heard, start = Heard(), Jobs._start
    Jobs._start = lambda self: None  # type: ignore[method-assign]
    logging.getLogger("beliefscope.app").addHandler(heard)
    try:
        application = create_app(given_, warm=False)
        client = TestClient(application, ORIGIN, raise_server_exceptions=False, headers={"Origin": ORIGIN})
        with client:
            yield client, heard
    finally:
        Jobs._start = start  # type: ignore[method-assign]
        logging.getLogger("beliefscope.app").removeHandler(heard)


def description(client: TestClient) -> dict[str, Any]:
    """The server's own, in which parameters know some of the values that exist, so that inputs get past the names."""
    document = client.app.openapi()  # type: ignore[attr-defined]
    catalog = client.get("/api/catalog").json()["tasks"]
    texts = [text for text in mutate.TEXTS if text.isprintable()]
    known: dict[str, list[Any]] = {
        "task": [task["name"] for task in catalog],
        "filter": [one["name"] for task in catalog for one in task["filters"]],
        "data": [one["name"] for task in catalog for one in task["data"]],
        "episode": [0, 1],
        "faults": [*FAULT_PRESETS.values(), *map(str, mutate.NUMBERS), *(f"blackout={text}" for text in texts)],
        "against": ["faults=blackout", "filter=small", "from=2&to=5&faults=blackout", "from=2&to=4&weights=image=1"],
        "name": list(DIAGNOSTICS),
    }
    for path in document["paths"].values():
        for operation in path.values():
            for parameter in operation.get("parameters", ()):
                values = known.get(parameter["name"])
                if values:
                    parameter["schema"] = {"anyOf": [{"enum": values}, {"enum": values}, parameter["schema"]]}
            if operation["operationId"].startswith("start"):  # of a fine-tuning: the settings are checked by ours
                properties = {name: {} for name in FineTune().to_json()}
                body = operation["requestBody"]["content"]["application/json"]
                body["schema"] = {"type": "object", "properties": properties}
    return document


def ask_http(client: TestClient, heard: Heard, inputs: int, number: int) -> Tally:
    """So many requests over all routes: half as the description says, half against it."""
    tally = Tally()
    schema = schemathesis.openapi.from_dict(description(client))
    operations = [result.ok() for result in schema.get_all_operations()]
    each = -(-inputs // sum(bool(one.definition.raw.keys() & {"parameters", "requestBody"}) for one in operations))
    jobs = client.app.state.jobs  # type: ignore[attr-defined]
    for place, operation in enumerate(operations):
        left = operation.method.upper(), operation.path

        def send(case: schemathesis.Case, left: tuple[str, str] = left) -> None:
            sent = case.as_transport_kwargs(base_url=ORIGIN)
            sent["headers"] = {"Origin": ORIGIN, **(sent.get("headers") or {})}
            request = {k: sent[k] for k in ("headers", "params", "json", "data", "cookies") if sent.get(k) is not None}
            try:
                answer = client.request(sent["method"], sent["url"], **request)
            except (UnicodeError, ValueError, TypeError) as error:  # no client can send it
                tally.answers[f"not sent: {type(error).__name__}"] += 1
                return
            tally.inputs += 1
            tally.answers[f"{answer.status_code // 100}xx"] += 1
            kind = answer.headers.get("content-type", "")
            wrong = answer.status_code >= 500 or (
                answer.status_code >= 400 and (not kind.startswith("application/json") or "error" not in answer.json())
            )
            if wrong or heard.records:
                said = heard.records.pop() if heard.records else answer.text[:300]
                tally.failures.setdefault(
                    f"{' '.join(left)}: {answer.status_code} {said}", repr((sent, request))[:2000]
                )
                heard.records.clear()
            if len(jobs.all()) >= 12:
                for job in jobs.all():
                    jobs.cancel(job.id)

        for mode, count in ((GenerationMode.POSITIVE, each - each // 2), (GenerationMode.NEGATIVE, each // 2)):
            try:
                _drawn(operation.as_strategy(generation_mode=mode), count, number + place)(send)
            except Exception as error:
                if type(error).__name__ not in ("SkipTest", "Unsatisfiable", "InvalidArgument"):
                    raise
                # Nothing can be wrong about a route that is told nothing: it is asked as it is.
                _drawn(operation.as_strategy(), count, number + place)(send)
    return tally


def _drawn(strategy: st.SearchStrategy[Any], count: int, number: int) -> Callable[[Callable[[Any], None]], None]:
    """Runs a function with that many values of a strategy, the same for the same number."""

    def run(function: Callable[[Any], None]) -> None:
        @seed(number)
        @settings(
            max_examples=max(count, 1),
            phases=[Phase.generate],
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        )
        @given(strategy)
        def each(value: Any) -> None:
            function(value)

        each()

    return run


CURSOR: dict[str, Any] = {
    "type": "cursor",
    "serial": 1,
    "task": "door",
    "filter": "crossmodal-ekf",
    "episode": 1,
    "step": 3,
    "angle": None,
    "size": 41,
    "faults": "",
    "data": "",
    "against": "",
    "scene": False,
    "beside": False,
}
WHOLE = (CURSOR, {"type": "theme", "dark": True}, {"type": "look", "hidden": ["particles"], "ground": "fused"})

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text()
    | st.sampled_from([*mutate.NUMBERS, *mutate.TEXTS, *FAULT_PRESETS.values()]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@st.composite
def _edited(draw: st.DrawFn) -> str:
    """A message that is right but for one or two of its fields."""
    message = dict(draw(st.sampled_from(WHOLE)))
    for _ in range(draw(st.integers(0, 2))):
        key = draw(st.sampled_from([*message, "other"]))
        if draw(st.booleans()):
            message[key] = draw(VALUES)
        else:
            message.pop(key, None)
    return json.dumps(message)


MESSAGES: st.SearchStrategy[str | bytes] = st.one_of(
    _edited(),
    _edited(),
    VALUES.map(json.dumps),
    st.text(st.characters(exclude_categories=["Cs"])),
    st.sampled_from([raw.decode(errors="replace") for raw in mutate.RAW]),
    st.binary(max_size=64),
)
"""Nearly right cursors, JSON of any shape, huge and deep ones, text that is none, and what is not text at all."""


def ask_socket(client: TestClient, heard: Heard, inputs: int, number: int) -> Tally:
    """So many messages to a view, each followed by one whose answer says that the view still hears."""
    tally = Tally()
    view: dict[str, Any] = {}

    def opened() -> WebSocketTestSession:
        if not view:
            made = client.post("/api/views").json()
            view["name"] = made["view"]
            view["socket"] = client.websocket_connect(
                f"ws://localhost:8000{made['socket']}", headers={"Origin": ORIGIN}
            )
            view["socket"].__enter__()
        return view["socket"]

    def closed() -> None:
        view.pop("socket").__exit__(None, None, None)
        view.clear()

    def send(message: str | bytes) -> None:
        socket = opened()
        tally.inputs += 1
        if isinstance(message, bytes):
            socket.send_bytes(message)
            while socket.receive()["type"] != "websocket.close":
                pass  # a drawing that an earlier message asked for may still come
            closed()
            tally.answers["closed"] += 1
            return
        socket.send_text(message)
        socket.send_text('{"type": "still there?", "serial": -7}')
        while True:
            answer = socket.receive()
            if answer["type"] == "websocket.close":
                tally.failures.setdefault("closed", repr(message)[:2000])
                view.clear()
                return
            said = json.loads(answer["text"]) if answer.get("text") else {"type": "maps"}
            if said.get("serial") == -7:
                break
            tally.answers[said["type"]] += 1
            if "The server failed" in str(said.get("error")):
                tally.failures.setdefault(f"{said['error']} {heard.records}", repr(message)[:2000])
                heard.records.clear()

    _drawn(MESSAGES, inputs, number)(send)
    if view:
        closed()
    for record in heard.records:
        tally.failures.setdefault(record, "")
    heard.records.clear()
    return tally


def left_over(workspace: Path) -> list[str]:
    """Files that were begun and not finished."""
    return [str(path.relative_to(workspace)) for path in workspace.rglob(".*") if path.is_file()]


def threads_after(before: int, patience: float = 10.0) -> int:
    """How many more threads there are than before, once they have had the time to end."""
    until = time.monotonic() + patience
    while threading.active_count() > before and time.monotonic() < until:
        time.sleep(0.05)
    return threading.active_count() - before

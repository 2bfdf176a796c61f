"""Invalid requests to the server: HTTP requests from its OpenAPI schema, and messages to a view's WebSocket."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mutate
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings, strategies as st
from schemathesis import GenerationMode
from starlette.testclient import TestClient, WebSocketTestSession

from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app
from beliefscope.datasets.faults.injection import FAULT_PRESETS
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.inspect.catalog import DIAGNOSTICS

ORIGIN = "http://localhost:8000"


@dataclass
class Tally:
    """Number of inputs, answers by kind, and failures: description -> an input that causes it."""

    inputs: int = 0
    answers: Counter[str] = field(default_factory=Counter)
    failures: dict[str, str] = field(default_factory=dict)


class ErrorLog(logging.Handler):
    """Collects errors logged by the server."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.records: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(f"{record.getMessage()}: {record.exc_info and record.exc_info[1]!r}")


@contextmanager
def running_server(settings_: Settings) -> Iterator[tuple[TestClient, ErrorLog]]:
    """A server in this process whose jobs are queued but never run."""
    log, run = ErrorLog(), Jobs._run
    Jobs._run = lambda self, id, arguments: None  # type: ignore[method-assign]
    logging.getLogger("beliefscope.app").addHandler(log)
    try:
        application = create_app(settings_, warm=False)
        client = TestClient(application, ORIGIN, raise_server_exceptions=False, headers={"Origin": ORIGIN})
        with client:
            yield client, log
    finally:
        Jobs._run = run  # type: ignore[method-assign]
        logging.getLogger("beliefscope.app").removeHandler(log)


def openapi_schema(client: TestClient) -> dict[str, Any]:
    """OpenAPI schema with existing names as parameter values, so that requests pass the name lookup."""
    document = client.app.openapi()  # type: ignore[attr-defined]
    catalog = client.get("/api/catalog").json()["tasks"]
    texts = [text for text in mutate.TEXTS if text.isprintable()]
    examples: dict[str, list[Any]] = {
        "task": [task["name"] for task in catalog],
        "filter": [entry["name"] for task in catalog for entry in task["filters"]],
        "data": [entry["name"] for task in catalog for entry in task["data"]],
        "episode": [0, 1],
        "faults": [*FAULT_PRESETS.values(), *map(str, mutate.NUMBERS), *(f"blackout={text}" for text in texts)],
        "against": ["faults=blackout", "filter=small", "from=2&to=5&faults=blackout", "from=2&to=4&weights=image=1"],
        "name": list(DIAGNOSTICS),
    }
    for path in document["paths"].values():
        for operation in path.values():
            for parameter in operation.get("parameters", ()):
                values = examples.get(parameter["name"])
                if values:
                    parameter["schema"] = {"anyOf": [{"enum": values}, {"enum": values}, parameter["schema"]]}
            if operation["operationId"].startswith("start"):  # fine-tuning settings
                properties = {name: {} for name in FineTune().to_json()}
                body = operation["requestBody"]["content"]["application/json"]
                body["schema"] = {"type": "object", "properties": properties}
    return document


def can_be_invalid(operation: Mapping[str, Any]) -> bool:
    """Whether a request can violate the schema: free text in the path cannot, and the search for it takes seconds."""

    def is_free_text(schema: Mapping[str, Any]) -> bool:
        plain = schema.keys() - {"title"} == {"type"} and schema["type"] == "string"
        return plain or any(map(is_free_text, schema.get("anyOf", ())))

    parameters = operation.get("parameters", ())
    return "requestBody" in operation or not all(p["in"] == "path" and is_free_text(p["schema"]) for p in parameters)


def fuzz_http(client: TestClient, log: ErrorLog, inputs: int, number: int) -> Tally:
    """Send requests to all routes: half valid, half invalid according to the schema."""
    tally = Tally()
    schema = schemathesis.openapi.from_dict(openapi_schema(client))
    operations = [result.ok() for result in schema.get_all_operations()]
    each = -(-inputs // sum(bool(o.definition.raw.keys() & {"parameters", "requestBody"}) for o in operations))
    jobs = client.app.state.jobs  # type: ignore[attr-defined]
    for index, operation in enumerate(operations):
        route = f"{operation.method.upper()} {operation.path}"

        def send(case: schemathesis.Case, route: str = route) -> None:
            arguments = case.as_transport_kwargs(base_url=ORIGIN)
            arguments["headers"] = {"Origin": ORIGIN, **(arguments.get("headers") or {})}
            keys = ("headers", "params", "json", "data", "cookies")
            request = {k: arguments[k] for k in keys if arguments.get(k) is not None}
            try:
                answer = client.request(arguments["method"], arguments["url"], **request)
            except (UnicodeError, ValueError, TypeError) as error:  # clients cannot send it
                tally.answers[f"not sent: {type(error).__name__}"] += 1
                return
            tally.inputs += 1
            tally.answers[f"{answer.status_code // 100}xx"] += 1
            kind = answer.headers.get("content-type", "")
            failed = answer.status_code >= 500 or (
                answer.status_code >= 400 and (not kind.startswith("application/json") or "error" not in answer.json())
            )
            if failed or log.records:
                message = log.records.pop() if log.records else answer.text[:300]
                tally.failures.setdefault(f"{route}: {answer.status_code} {message}", repr((arguments, request))[:2000])
                log.records.clear()
            if len(jobs.all()) >= 12:
                for job in jobs.all():
                    jobs.cancel(job.id)

        second = GenerationMode.NEGATIVE if can_be_invalid(operation.definition.raw) else GenerationMode.POSITIVE
        for mode, count in ((GenerationMode.POSITIVE, each - each // 2), (second, each // 2)):
            _for_each(operation.as_strategy(generation_mode=mode), count, number + index)(send)
    return tally


def _for_each(strategy: st.SearchStrategy[Any], count: int, number: int) -> Callable[[Callable[[Any], None]], None]:
    """Return a function that calls another one with ``count`` values of a strategy; deterministic for a number."""

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
VALID_MESSAGES = (
    CURSOR,
    {"type": "theme", "dark": True},
    {"type": "scene_layers", "hidden": ["particles"], "ground": "fused"},
)

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
def _edited_messages(draw: st.DrawFn) -> str:
    """Valid messages with up to two modified fields."""
    message = dict(draw(st.sampled_from(VALID_MESSAGES)))
    for _ in range(draw(st.integers(0, 2))):
        key = draw(st.sampled_from([*message, "other"]))
        if draw(st.booleans()):
            message[key] = draw(VALUES)
        else:
            message.pop(key, None)
    return json.dumps(message)


MESSAGES: st.SearchStrategy[str | bytes] = st.one_of(
    _edited_messages(),
    _edited_messages(),
    VALUES.map(json.dumps),
    st.text(st.characters(exclude_categories=["Cs"])),
    st.sampled_from([raw.decode(errors="replace") for raw in mutate.RAW]),
    st.binary(max_size=64),
)
"""Nearly valid messages, arbitrary, huge and deeply nested JSON, other text, and bytes."""


def fuzz_socket(client: TestClient, log: ErrorLog, inputs: int, number: int) -> Tally:
    """Send messages to a view, each followed by one whose answer shows that the view still responds."""
    tally = Tally()
    view: dict[str, Any] = {}

    def connect() -> WebSocketTestSession:
        if not view:
            addresses = client.post("/api/views").json()
            url = f"ws://localhost:8000{addresses['socket']}"
            view["socket"] = client.websocket_connect(url, headers={"Origin": ORIGIN})
            view["socket"].__enter__()
        return view["socket"]

    def disconnect() -> None:
        view.pop("socket").__exit__(None, None, None)
        view.clear()

    def send(message: str | bytes) -> None:
        socket = connect()
        tally.inputs += 1
        if isinstance(message, bytes):
            socket.send_bytes(message)
            while socket.receive()["type"] != "websocket.close":
                pass  # answers to earlier messages may still arrive
            disconnect()
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
            reply = json.loads(answer["text"]) if answer.get("text") else {"type": "maps"}
            if reply.get("serial") == -7:
                break
            tally.answers[reply["type"]] += 1
            if "The server failed" in str(reply.get("error")):
                tally.failures.setdefault(f"{reply['error']} {log.records}", repr(message)[:2000])
                log.records.clear()

    _for_each(MESSAGES, inputs, number)(send)
    if view:
        disconnect()
    for record in log.records:
        tally.failures.setdefault(record, "")
    log.records.clear()
    return tally


def temporary_files(workspace: Path) -> list[str]:
    """Temporary files that were not removed."""
    return [str(path.relative_to(workspace)) for path in workspace.rglob(".*") if path.is_file()]


def extra_threads(before: int, timeout: float = 10.0) -> int:
    """Number of threads beyond ``before``, after waiting for threads to end."""
    deadline = time.monotonic() + timeout
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.05)
    return threading.active_count() - before

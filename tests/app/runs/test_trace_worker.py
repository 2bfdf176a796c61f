"""Filters run in a worker process: identical traces, crashes, errors, shutdown, imports."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.trace_worker import RunRequest, TraceWorker
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.trace import arrays_of, header_of

pytestmark = pytest.mark.slow

SELECTION = Selection("door", "crossmodal-pf", 1, data="mine")
OTHER = Selection("door", "crossmodal-ekf", 0, data="mine")
TIMEOUT = 60.0  # s


@pytest.fixture
def worker() -> Iterator[TraceWorker]:
    worker = TraceWorker()
    worker.start()  # or the first run would be computed in this process
    yield worker
    worker.close()


@pytest.fixture
def store(settings: Settings, worker: TraceWorker) -> Iterator[TraceStore]:
    store = TraceStore(settings, worker)
    yield store
    store.close()


def pid(worker: TraceWorker) -> int:
    assert worker._process is not None
    return worker._process.pid


def stop(process: int) -> None:
    """Stop a process, and wait until all of its threads are stopped: until then, it reads from its pipe."""
    os.kill(process, signal.SIGSTOP)
    os.waitpid(process, os.WUNTRACED)


def wait_for_call(worker: TraceWorker) -> None:
    """Wait until a call waits in the pipe of the stopped process."""
    assert worker._process is not None
    assert worker._process.stdin is not None
    end, unread = time.monotonic() + TIMEOUT, bytearray(4)
    while not any(unread):
        assert time.monotonic() < end, "no call"
        time.sleep(0.01)
        fcntl.ioctl(worker._process.stdin.fileno(), termios.FIONREAD, unread)


def request(store: TraceStore, selection: Selection) -> RunRequest:
    return store._run_request(selection, store.checkpoint(selection.task, selection.filter))


def test_traces_are_identical_and_a_killed_worker_is_replaced(
    store: TraceStore, worker: TraceWorker, settings: Settings
) -> None:
    local = TraceStore(replace(settings, workspace=settings.workspace / "local"))
    for selection in (SELECTION, SELECTION.comparison("from=5&to=10&faults=blackout")):
        expected = local.request(selection).trace
        result = store.request(selection).future.result(TIMEOUT)
        assert header_of(result) == header_of(expected)
        for name, array in arrays_of(expected).items():
            np.testing.assert_array_equal(arrays_of(result)[name], array, err_msg=name)
    local.close()
    assert len(list((settings.workspace / "traces").iterdir())) == 1, "traces of interventions are not kept"

    first = pid(worker)
    stop(first)  # during the next run
    run = store.request(OTHER)
    wait_for_call(worker)  # a process that is dead before is replaced
    os.kill(first, signal.SIGKILL)
    with pytest.raises(RuntimeError, match=r"its process was ended by signal 9 \(SIGKILL\)"):
        run.future.result(TIMEOUT)
    assert len(store.request(OTHER).future.result(TIMEOUT)) == 40
    assert pid(worker) != first


def test_errors_are_reported_and_close_ends_a_run(store: TraceStore, worker: TraceWorker) -> None:
    invalid = request(store, SELECTION)
    with pytest.raises(BadInput, match="'missing' does not exist"):
        worker.run(replace(invalid, checkpoint="missing"), lambda _: None)
    with pytest.raises(RuntimeError, match="RuntimeError: manual_seed"):
        worker.run(replace(invalid, seed="text"), lambda _: None)  # type: ignore[arg-type]
    stop(pid(worker))
    run = store.request(SELECTION)
    closing = threading.Thread(target=store.close)
    closing.start()
    closing.join(TIMEOUT)
    assert not closing.is_alive()
    with pytest.raises(RuntimeError, match=r"signal 9|the server is stopping"):  # started before or after the close
        run.future.result(TIMEOUT)


def test_requests_survive_json(settings: Settings) -> None:
    store = TraceStore(settings)
    for selection in (SELECTION, SELECTION.comparison("from=5&to=10&faults=blackout&weights=image=0.5")):
        assert Selection.from_json(selection.to_json()) == selection
        original = request(store, selection)
        assert RunRequest.from_json(original.to_json()) == original
    store.close()


@pytest.mark.long
def test_the_worker_imports_no_web_or_viewer_packages() -> None:
    code = "import sys, beliefscope.app.runs.trace_worker; print([m for m in sys.argv[1:] if m in sys.modules])"
    packages = ["fastapi", "starlette", "uvicorn", "viser", "rerun", "matplotlib", "beliefscope.app.runs.trace_store"]
    output = subprocess.run([sys.executable, "-c", code, *packages], capture_output=True, text=True, check=True).stdout
    assert output == "[]\n"

"""Filters run in a process of their own: a real one, killed, refused, and closed in the midst of a run."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from beliefscope.app.runs.trace_store import Library, Selection, Settings
from beliefscope.app.runs.trace_worker import Tracer
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.trace import arrays_of, header_of

EPISODE = Selection("door", "crossmodal-pf", 1, data="mine")
PATIENCE = 60.0  # s


@pytest.fixture
def tracer() -> Iterator[Tracer]:
    tracer = Tracer()
    yield tracer
    tracer.close()


@pytest.fixture
def library(settings: Settings, tracer: Tracer) -> Iterator[Library]:
    library = Library(settings, tracer)
    yield library
    library.close()


def pid(tracer: Tracer) -> int:
    assert tracer._process is not None
    return tracer._process.pid


def test_traces_are_those_of_this_process_and_a_killed_one_is_replaced(
    library: Library, tracer: Tracer, settings: Settings
) -> None:
    inside = Library(settings)
    edited = EPISODE.against("from=5&to=10&faults=blackout")
    for selection in (EPISODE, edited):
        # By itself first: it reads the file that the other one writes.
        ours = inside.traced(selection).trace
        for file in (settings.workspace / "traces").iterdir():
            file.unlink()
        theirs = library.traced(selection).done.result(PATIENCE)
        assert header_of(theirs) == header_of(ours)
        for name, array in arrays_of(ours).items():
            np.testing.assert_array_equal(arrays_of(theirs)[name], array, err_msg=name)
    inside.close()
    # The edit's file is gone: it is soon made again.
    assert len(list((settings.workspace / "traces").iterdir())) == 1

    first = pid(tracer)
    os.kill(first, signal.SIGSTOP)  # in the midst of the next one
    traced = library.traced(Selection("door", "crossmodal-ekf", 0, data="mine"))
    os.kill(first, signal.SIGKILL)
    with pytest.raises(RuntimeError, match=r"its process was ended by signal 9 \(SIGKILL\)"):
        traced.done.result(PATIENCE)
    assert len(library.traced(Selection("door", "crossmodal-ekf", 0, data="mine")).done.result(PATIENCE)) == 40
    assert pid(tracer) != first


def test_what_is_wrong_with_a_run_is_said_and_closing_ends_it(library: Library, tracer: Tracer) -> None:
    order = (library.settings.to_json(), EPISODE.to_json() | {"filter": "none"}, library.settings.workspace / "x.trace")
    with pytest.raises(BadInput, match=r"filter 'none' does not exist. Available: crossmodal-ekf"):
        tracer.run(*order, lambda _: None)
    os.kill(pid(tracer), signal.SIGSTOP)
    traced = library.traced(EPISODE)
    closing = threading.Thread(target=library.close)
    closing.start()
    closing.join(PATIENCE)
    assert not closing.is_alive()
    with pytest.raises(RuntimeError, match=r"signal 9|the server is stopping"):  # begun before or after it was closed
        traced.done.result(PATIENCE)


def test_selections_travel() -> None:
    for selection in (EPISODE, EPISODE.against("from=5&to=10&faults=blackout&weights=image=0.5")):
        assert Selection.of_json(selection.to_json()) == selection

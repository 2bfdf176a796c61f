"""Processes: every item exactly once, whatever happens to the processes."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import subprocess
import sys
import threading
from contextlib import closing
from functools import partial
from itertools import count
from pathlib import Path

import pytest

from beliefscope.datasets.parallel import LOSSES, run_in_processes

pytestmark = pytest.mark.slow


def square_once_killed(folder: Path, number: int) -> int:
    """The square; the process of every fourth number kills itself the first time, as the kernel does without memory."""
    marker = folder / str(number)
    if number % 4 == 0 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def always_killed(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


def process_of(number: int) -> int:
    return os.getpid()


def reciprocal(number: int) -> float:
    return 1 / number


def lock(number: int) -> object:
    return threading.Lock()


def blocked_signals(number: int) -> set[int]:
    return signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_ctrl_c_does_not_interrupt_the_imports_of_the_processes() -> None:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    ((_, blocked),) = run_in_processes(blocked_signals, [0], workers=1)
    assert signal.SIGINT in blocked
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


def test_items_of_killed_processes_run_again(tmp_path: Path) -> None:
    results = list(run_in_processes(partial(square_once_killed, tmp_path), range(9), workers=2))
    assert sorted(results) == [(i, i**2) for i in range(9)]
    assert len(list(tmp_path.iterdir())) == 3


def test_fails_if_no_process_survives() -> None:
    assert LOSSES > 1
    with pytest.raises(ChildProcessError, match=f"{LOSSES} processes in a row were killed"):
        list(run_in_processes(always_killed, range(3), workers=1))


PREPARED = """
import sys
from beliefscope.datasets.parallel import prepare_processes, run_in_processes

def is_imported(name):
    return name in sys.modules

if __name__ == "__main__":
    prepare_processes("colorsys")
    print(sorted(run_in_processes(is_imported, ["colorsys", "this"], 1)))
"""


@pytest.mark.skipif("forkserver" not in multiprocessing.get_all_start_methods(), reason="needs forks")
def test_prepared_processes_have_imported_the_module(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(PREPARED)
    printed = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True).stdout
    assert printed == "[('colorsys', True), ('this', False)]\n"


def test_processes_end_with_the_generator() -> None:
    with closing(run_in_processes(process_of, iter(range(1000)), workers=1)) as results:
        _, process = next(results)
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_keeps_the_traceback_of_the_process() -> None:
    with pytest.raises(ZeroDivisionError) as caught:
        list(run_in_processes(reciprocal, [1, 0], workers=2))
    assert any("in reciprocal" in note for note in caught.value.__notes__)


def test_results_that_cannot_be_pickled_are_errors() -> None:
    with pytest.raises(TypeError, match="pickle"):
        list(run_in_processes(lock, [0], workers=1))


def run_until_interrupted(after: float) -> None:
    signal.setitimer(signal.ITIMER_REAL, after)
    for _ in run_in_processes(abs, count(), workers=2):
        pass


class Interruption(BaseException):
    """Raised by a signal, as Ctrl-C does."""


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs interval timers")
def test_signals_at_any_moment_end_the_processes() -> None:
    def interrupt(*_: object) -> None:
        raise Interruption

    moments = random.Random(0)
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        for _ in range(100):
            with pytest.raises(Interruption):
                run_until_interrupted(moments.uniform(0.001, 0.04))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert not multiprocessing.active_children()

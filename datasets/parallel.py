"""Runs a function over many items in several processes, which survive the loss of one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable
from contextlib import suppress
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

ATTEMPTS, PAUSE = 20, 0.02
"""Number of attempts to start a process, and s between them."""

LOSSES = 3
"""Number of lost processes in a row, without a finished item between them, after which the run fails."""


def run_in_processes(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Generator[tuple[Item, Result]]:
    """Call ``function`` with each item in ``workers`` processes; yields items and results in the order they finish.

    Function, items and results must be picklable. If a process is killed, for example by lack of memory, its item runs
    again in another one. The processes end with this one, and when the generator is closed.

    Raises what the function raises, and ``ChildProcessError`` after ``LOSSES`` losses in a row.
    """
    # Pipes, not the threads of a ProcessPoolExecutor: a signal that raises may leave one of its locks locked for ever.
    context = _context(_modules(function))
    remaining, queue, losses = iter(items), list[Item](), 0
    processes, running = dict[Connection, Any](), dict[Connection, Item]()
    finished: list[tuple[Item, Result]] = []
    try:
        while True:
            queue += islice(remaining, max(0, workers - len(running) - len(queue)))
            while queue and len(running) < workers:
                idle = next((each for each in processes if each not in running), None)
                connection = idle or _start(context, function, processes)
                running[connection] = queue.pop(0)
                with suppress(OSError):  # of a lost process: its connection ends without a result
                    connection.send(running[connection])
            yield from finished  # while the processes work
            if not running:
                return
            ready = wait(running)
            finished = []
            for connection in [each for each in running if each in ready]:
                item = running.pop(connection)
                try:
                    result, error = connection.recv()
                except (EOFError, OSError):
                    lost = processes.pop(connection)
                    lost.terminate()  # or it cannot be read
                    lost.join()
                    queue.append(item)
                    losses += 1
                    if losses == LOSSES:
                        raise ChildProcessError(f"{losses} processes in a row were killed") from None
                    continue
                if error is not None:
                    raise error
                finished.append((item, result))
                losses = 0
    except BaseException:
        for process in processes.values():
            process.terminate()
        raise
    finally:
        for connection, process in processes.items():
            connection.close()
            process.join()


def _start(context: Any, function: Callable[[Item], object], processes: dict[Connection, Any]) -> Connection:
    """Start a process and add it to ``processes``; returns the connection that sends items and receives results."""
    ours: Connection
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,))
    for attempt in range(ATTEMPTS):
        try:
            process.start()
            break
        except (ConnectionError, EOFError):  # the server of forks ended with an interrupted start; it starts again
            if attempt == ATTEMPTS - 1:
                raise
            time.sleep(PAUSE)
    processes[ours] = process
    theirs.close()
    with suppress(OSError):  # of a lost process
        ours.send(function)
    return ours


def prepare_processes(module: str) -> None:
    """Begin to import a module for the processes of the first ``run_in_processes``, while this one imports it too."""
    _context({module})


def _context(modules: set[str]) -> BaseContext:
    """How processes start: not as forks of this one, since locks held by its threads would stay locked.

    Where possible they are forks of a process that has only imported the modules, so that PyTorch is imported once
    instead of by every process.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    from multiprocessing import forkserver, resource_tracker  # not on Windows

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(sorted(modules))
    # Ctrl-C is for this process, which stops the others: it must not interrupt their imports with a traceback.
    resource_tracker.ensure_running()  # unblocks the signal
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    return context


def _modules(function: Callable[..., object]) -> set[str]:
    """Modules that define a function, or the functions of a partial one."""
    if isinstance(function, partial):
        parts = [function.func, *(value for value in function.args if callable(value))]
        return set().union(*map(_modules, parts))
    owner = getattr(function, "__self__", function)  # a bound method is defined by its object's class
    return {getattr(owner, "__module__", __name__)} - {"__main__"}


def _work(connection: Connection) -> None:
    """In a process: receive a function, and call it with each item that follows until the connection is closed.

    Ignores Ctrl-C, and exits when the parent process ends for any reason.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):
        function = connection.recv()
        while True:
            item = connection.recv()
            try:
                connection.send((function(item), None))
            except Exception as error:  # also that of a result that cannot be pickled
                error.add_note(f"In a process of its own:\n{traceback.format_exc()}")
                connection.send((None, error))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)

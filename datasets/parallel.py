"""Runs a function over many items in several processes, which survive the loss of one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from itertools import islice
from multiprocessing.context import BaseContext
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

LOSSES = 3
"""Number of lost processes in a row, without a finished item between them, after which the run fails."""


def run_in_processes(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Generator[tuple[Item, Result]]:
    """Call ``function`` with each item in ``workers`` processes; yields items and results in the order they finish.

    Function, items and results must be picklable. If a process is killed, for example by lack of memory, its item runs
    again, like all others that the pool was working on. The processes end with this one, and when the generator is
    closed.

    Raises what the function raises, and ``BrokenProcessPool`` after ``LOSSES`` losses in a row.
    """
    remaining, losses = iter(items), 0
    queue: list[Item] = []
    while True:
        pool = ProcessPoolExecutor(workers, _context(_modules(function)), _start_worker, (function,))
        running: dict[Future[Result], Item] = {}
        try:
            while True:
                # A short queue, because a lost process loses everything in it; items may be many.
                queue += islice(remaining, max(0, 2 * workers - len(running) - len(queue)))
                while queue and len(running) < 2 * workers:
                    running[pool.submit(_call, queue[0])] = queue[0]
                    del queue[0]
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    result = future.result()
                    losses = 0
                    yield running.pop(future), result
        except BrokenProcessPool:
            losses += 1
            if losses == LOSSES:
                raise
            queue = [*running.values(), *queue]
        finally:
            pool.shutdown(cancel_futures=True)


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


_function: Callable[[Any], Any]
"""In a worker: the function to call. It is sent once, because it may contain a filter."""


def _call(item: Any) -> Any:
    return _function(item)


def _start_worker(function: Callable[[Any], Any]) -> None:
    """Initialize a worker: keep the function, ignore Ctrl-C, and exit when the parent process ends for any reason."""
    global _function
    _function = function
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

"""Scheduling of short computations for many clients on a few threads."""

import asyncio
import os
import threading
import time
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(eq=False)
class _Task:
    deadline: float
    resources: frozenset[Hashable]
    work: Callable[[], Any]
    future: asyncio.Future[Any]


class DeadlineExecutor:
    """Thread pool that runs the task with the earliest deadline first.

    Two tasks that need the same resource never run at the same time. Each client awaits its task before it submits the
    next one, so the queue holds at most one task per client. Threads start with the first tasks.

    threads: number of threads; by default one per processor, between 2 and 4, because more would only compete for
    Python's global lock.
    """

    def __init__(self, threads: int | None = None) -> None:
        self._max_threads = threads or min(4, max(2, os.cpu_count() or 2))
        self._threads: list[threading.Thread] = []
        self._condition = threading.Condition()
        self._pending: set[_Task] = set()  # waiting or running
        self._waiting: list[_Task] = []
        self._busy: set[Hashable] = set()  # resources of running tasks
        self._closed = False

    async def run(self, work: Callable[[], T], within: float, resources: frozenset[Hashable] = frozenset()) -> T:
        """Run ``work`` in a thread and return its result. A cancelled task is removed, unless it has started.

        within: deadline, in s from now. resources: used exclusively while the task runs. Raises RuntimeError if the
        executor is closed.
        """
        loop = asyncio.get_running_loop()
        task = _Task(time.monotonic() + within, resources, work, loop.create_future())
        with self._condition:
            if self._closed:
                raise RuntimeError("the server is stopping")
            self._waiting.append(task)
            self._pending.add(task)
            if len(self._threads) < self._max_threads:
                self._threads.append(threading.Thread(target=self._work, name="deadline-executor", daemon=True))
                self._threads[-1].start()
            self._condition.notify()
        try:
            return await task.future
        finally:
            with self._condition:
                self._pending.remove(task)
                if task in self._waiting:
                    self._waiting.remove(task)

    def overdue(self) -> float:
        """Time in s since the earliest deadline of all pending tasks; 0 if none has passed."""
        with self._condition:
            return max([0.0, *(time.monotonic() - task.deadline for task in self._pending)])

    def close(self) -> None:
        """Discard waiting tasks and end the threads after their current ones. Blocks."""
        with self._condition:
            self._closed = True
            self._waiting.clear()
            self._condition.notify_all()
        for thread in self._threads:
            thread.join()

    def _work(self) -> None:
        while (task := self._next()) is not None:
            result, error = None, None
            try:
                result = task.work()
            except BaseException as exception:
                error = exception
            with self._condition:
                self._busy -= task.resources
                self._condition.notify_all()
            _resolve(task.future, result, error)
            del task, result, error  # an idle thread must not keep the last trace in memory

    def _next(self) -> _Task | None:
        """Wait for the next task; None once the executor is closed."""
        with self._condition:
            while not self._closed:
                runnable = [task for task in self._waiting if not task.resources & self._busy]
                if runnable:
                    task = min(runnable, key=lambda task: task.deadline)
                    self._waiting.remove(task)
                    self._busy |= task.resources
                    return task
                self._condition.wait()
        return None


class FairLock:
    """Asynchronous lock that is granted in order of arrival and stays locked for a pause after each use.

    pause: in s for each s that the lock was held. max_pause: in s.
    """

    def __init__(self, pause: float = 2.0, max_pause: float = 0.1) -> None:
        self._pause, self._max_pause = pause, max_pause
        self._lock = asyncio.Lock()
        self._acquired = 0.0

    async def __aenter__(self) -> None:
        await self._lock.acquire()
        self._acquired = time.monotonic()

    async def __aexit__(self, *_: object) -> None:
        pause = min(self._pause * (time.monotonic() - self._acquired), self._max_pause)
        asyncio.get_running_loop().call_later(pause, self._lock.release)


def _resolve(future: asyncio.Future[Any], result: Any, error: BaseException | None) -> None:
    def resolve() -> None:
        if future.done():
            return
        if error is None:
            future.set_result(result)
        else:
            future.set_exception(error)

    with suppress(RuntimeError):  # the event loop is closed
        future.get_loop().call_soon_threadsafe(resolve)

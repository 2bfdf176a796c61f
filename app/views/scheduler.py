"""Scheduling of short computations for many clients on a few threads."""

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncIterator, Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(eq=False)
class _Task:
    deadline: float
    resources: frozenset[Hashable]
    start: asyncio.Event = field(default_factory=asyncio.Event)


class DeadlineExecutor:
    """Thread pool that runs the task with the earliest deadline first.

    Two tasks that need the same resource never run at the same time. Each client awaits its task before it submits the
    next one, so the queue holds at most one task per client. Threads start with the first tasks. All methods but
    ``close`` are called in the event loop.

    threads: number of threads; by default one per processor, between 2 and 4, because more would only compete for
    Python's global lock.
    """

    def __init__(self, threads: int | None = None) -> None:
        self._max_running = threads or min(4, max(2, os.cpu_count() or 2))
        self._threads = ThreadPoolExecutor(self._max_running, "deadline-executor")
        self._waiting: list[_Task] = []
        self._running: list[_Task] = []
        self._closed = False

    async def run(self, work: Callable[[], T], within: float, resources: frozenset[Hashable] = frozenset()) -> T:
        """Run ``work`` in a thread and return its result. A cancelled task is removed, unless it has started.

        within: deadline, in s from now. resources: used exclusively while the task runs. Raises RuntimeError if the
        executor is closed.
        """
        if self._closed:
            raise RuntimeError("the server is stopping")
        task = _Task(time.monotonic() + within, resources)
        self._waiting.append(task)
        self._start_tasks()
        try:
            await task.start.wait()
        except asyncio.CancelledError:
            self._end(task)
            raise
        loop, running = asyncio.get_running_loop(), self._threads.submit(work)
        running.add_done_callback(lambda _: loop.call_soon_threadsafe(self._end, task))
        return await asyncio.wrap_future(running)

    def overdue(self) -> float:
        """Time in s since the earliest deadline of all waiting and running tasks; 0 if none has passed."""
        return max([0.0, *(time.monotonic() - task.deadline for task in self._waiting + self._running)])

    def close(self) -> None:
        """Discard waiting tasks and end the threads after their current ones. Blocks."""
        self._closed = True
        self._threads.shutdown(cancel_futures=True)

    def _start_tasks(self) -> None:
        while len(self._running) < self._max_running and not self._closed:
            busy = frozenset[Any]().union(*(task.resources for task in self._running))
            runnable = [task for task in self._waiting if not task.resources & busy]
            if not runnable:
                return
            task = min(runnable, key=lambda task: task.deadline)
            self._waiting.remove(task)
            self._running.append(task)
            task.start.set()

    def _end(self, task: _Task) -> None:
        """Remove a task that is done or cancelled."""
        (self._running if task in self._running else self._waiting).remove(task)
        self._start_tasks()


@contextlib.asynccontextmanager
async def held_with_pause(lock: asyncio.Lock, pause: float = 2.0, max_pause: float = 0.1) -> AsyncIterator[None]:
    """Hold a lock during the block; it then stays locked for a pause, before the next one in order of arrival has it.

    pause: in s for each s that the lock was held. max_pause: in s.
    """
    await lock.acquire()
    acquired = time.monotonic()
    try:
        yield
    finally:
        held = time.monotonic() - acquired
        asyncio.get_running_loop().call_later(min(pause * held, max_pause), lock.release)

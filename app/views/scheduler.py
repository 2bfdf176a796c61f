"""Short work of many askers on a few threads: what is due first is done first."""

from __future__ import annotations

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
    due: float
    needs: frozenset[Hashable]
    work: Callable[[], Any]
    answer: asyncio.Future[Any]


class Desk:
    """Threads that take work by its due time, and never two pieces at once that need the same thing.

    Each asker has one piece here at most, by its own waiting for the answer, so nobody can crowd out the others, and
    the queue is as long as there are askers. Few threads, because more of them only wait for one another: for Python's
    lock, and for a processor. The threads start with the first piece of work.

    Args:
        threads: as many as there are processors, at most four, by default.
    """

    def __init__(self, threads: int | None = None) -> None:
        self._count = threads or min(4, max(2, os.cpu_count() or 2))
        self._threads: list[threading.Thread] = []
        self._changed = threading.Condition()
        self._asked: set[_Task] = set()  # and not answered
        self._waiting: list[_Task] = []  # those of them that nobody has begun
        self._taken: set[Hashable] = set()
        self._closed = False

    async def do(self, work: Callable[[], T], within: float, needs: frozenset[Hashable] = frozenset()) -> T:
        """What the work returns, or raises.

        Args:
            within: s from now until when it is due: the more patient wait for those that are not.
            needs: things of which nobody else's work may have any at the same time.

        An asker that is cancelled takes its work back, unless it has begun. Raises RuntimeError once it is closed.
        """
        loop = asyncio.get_running_loop()
        task = _Task(time.monotonic() + within, needs, work, loop.create_future())
        with self._changed:
            if self._closed:
                raise RuntimeError("the server is stopping")
            self._waiting.append(task)
            self._asked.add(task)
            if len(self._threads) < self._count:
                self._threads.append(threading.Thread(target=self._serve, name="desk", daemon=True))
                self._threads[-1].start()
            self._changed.notify()
        try:
            return await task.answer
        finally:
            with self._changed:
                self._asked.remove(task)
                if task in self._waiting:
                    self._waiting.remove(task)

    def late(self) -> float:
        """s since when what is asked for was due, begun or not; 0 where nothing is late."""
        with self._changed:
            return max([0.0, *(time.monotonic() - task.due for task in self._asked)])

    def close(self) -> None:
        """Ends the threads after what they are doing. Blocks."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _serve(self) -> None:
        while (task := self._take()) is not None:
            found, error = None, None
            try:
                found = task.work()
            except BaseException as problem:
                error = problem
            with self._changed:
                self._taken -= task.needs
                self._changed.notify_all()
            _tell(task.answer, found, error)
            del task, found, error  # or the last one's trace stays in memory while nobody asks

    def _take(self) -> _Task | None:
        """The next piece of work; None once it is closed."""
        with self._changed:
            while not self._closed:
                free = [task for task in self._waiting if not task.needs & self._taken]
                if free:
                    task = min(free, key=lambda one: one.due)
                    self._waiting.remove(task)
                    self._taken |= task.needs
                    return task
                self._changed.wait()
        return None


class Turns:
    """Lets one asker in at a time (``async with``), in the order in which they came, with a rest after each.

    Args:
        rest: s for each s that it was in. longest: s.
    """

    def __init__(self, rest: float = 2.0, longest: float = 0.1) -> None:
        self._rest, self._longest = rest, longest
        self._lock = asyncio.Lock()
        self._began = 0.0

    async def __aenter__(self) -> None:
        await self._lock.acquire()
        self._began = time.monotonic()

    async def __aexit__(self, *_: object) -> None:
        rest = min(self._rest * (time.monotonic() - self._began), self._longest)
        asyncio.get_running_loop().call_later(rest, self._lock.release)


def _tell(answer: asyncio.Future[Any], found: Any, error: BaseException | None) -> None:
    def tell() -> None:
        if answer.done():
            return
        if error is None:
            answer.set_result(found)
        else:
            answer.set_exception(error)

    with suppress(RuntimeError):  # the server's loop has ended
        answer.get_loop().call_soon_threadsafe(tell)

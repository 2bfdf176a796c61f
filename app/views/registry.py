"""The open views of a server."""

import asyncio
import time

from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.views.memory import release_memory
from beliefscope.app.views.scheduler import DeadlineExecutor
from beliefscope.app.views.view_socket import View
from beliefscope.datasets.errors import BadInput


class Views:
    """The open views, up to a maximum number.

    limit: maximum number of views; each takes a thread and several MB (docs/reliability.md). timeout: in s, after which
    a view without a page is closed; allows for lost connections.
    """

    def __init__(self, store: TraceStore, limit: int = 32, timeout: float = 30.0) -> None:
        self._store = store
        self._executor = DeadlineExecutor()
        self._scene_lock = asyncio.Lock()
        self._limit = limit
        self._timeout = timeout
        self._views: dict[str, View] = {}
        self._open_lock = asyncio.Lock()

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, name: str) -> View:
        """Raises NotFound."""
        if name not in self._views:
            raise NotFound(f"View {name!r} is not open.")
        return self._views[name]

    def overdue(self) -> float:
        """Delay in s of maps and scenes, beyond their deadlines."""
        return self._executor.overdue()

    async def open(self, dark: bool) -> View:
        """Open a view; close the one that has been idle longest if there are too many.

        Raises BadInput if the maximum number of views is in use.
        """
        async with self._open_lock:
            await self._close_idle(keep=self._limit - 1)
            if len(self._views) >= self._limit:
                raise BadInput(
                    f"The maximum number of pages is open, {self._limit}. Close one and reload, or serve with more "
                    "--views."
                )
            view = await asyncio.to_thread(View, self._store, self._executor, self._scene_lock, dark)
            self._views[view.name] = view
            return view

    async def close_expired(self) -> None:
        """Close views whose page has been gone for longer than the timeout. Runs until cancelled."""
        while True:
            await asyncio.sleep(self._timeout / 4)
            await self._close_idle(keep=0, idle_for=self._timeout)

    async def close(self) -> None:
        """Close all views and end their threads."""
        views, self._views = list(self._views.values()), {}
        await asyncio.to_thread(self._executor.close)
        await asyncio.gather(*(asyncio.to_thread(view.scene.close) for view in views))

    async def _close_idle(self, keep: int, idle_for: float = 0.0) -> None:
        latest = time.monotonic() - idle_for
        idle = [v for v in self._views.values() if v.idle_since is not None and v.idle_since <= latest]
        idle.sort(key=lambda v: v.idle_since or 0.0)
        closing = idle[: max(0, len(self._views) - keep)]
        for view in closing:  # before the first await, so that no page can connect to a closing view
            del self._views[view.name]
        for view in closing:
            await asyncio.to_thread(view.scene.close)
        if idle:
            await asyncio.to_thread(release_memory)

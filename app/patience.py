"""HTTP as uvicorn speaks it, but for those who never finish a request: they are not waited for."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_PATIENCE = 15.0  # s from the first byte of a request to the end of its head
CONNECTIONS = 512  # at a time; more are answered 503
HEAD = 32 << 10  # bytes of a request's line and headers


class PatientProtocol(H11Protocol):
    """Closes a connection whose request's head does not come in time, one that sends nothing at all included."""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        if self._deadline is None and self._between():
            self._wait()
        super().data_received(data)
        # What took the connection over is a WebSocket, which has its own deadline for the handshake.
        if self._deadline is not None and (not self._between() or self.transport.get_protocol() is not self):
            self._deadline.cancel()
            self._deadline = None

    def connection_lost(self, exc: Exception | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        super().connection_lost(exc)

    def _wait(self) -> None:
        self._deadline = self.loop.call_later(HEAD_PATIENCE, self.transport.close)

    def _between(self) -> bool:
        """Whether no request is under way."""
        return self.cycle is None or self.cycle.response_complete

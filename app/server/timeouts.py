"""HTTP and WebSockets as uvicorn speaks them, but for those who do not take part: they are not waited for."""

from __future__ import annotations

import asyncio

from uvicorn._types import ASGIReceiveEvent
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

HEAD_PATIENCE = 15.0  # s from the first byte of a request to the end of its head
READ_PATIENCE = 60_000  # ms that the system keeps what a browser does not take; then the connection ends
CONNECTIONS = 512  # at a time, sockets among them
PARTS = 1024  # of one message
HEAD = 32 << 10  # bytes of a request's line and headers


def _refusal(status: str) -> bytes:
    return f"HTTP/1.1 {status}\r\nconnection: close\r\ncontent-length: 0\r\n\r\n".encode()


class PatientProtocol(H11Protocol):
    """Closes a connection whose request's head does not come in time, and one too many."""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._wait()
        if len(self.connections) > CONNECTIONS:
            transport.write(_refusal("503 Service Unavailable"))
            transport.close()

    def data_received(self, data: bytes) -> None:
        if self._deadline is None and self._between():
            self._wait()
        super().data_received(data)
        # What took the connection over is a WebSocket, whose head was whole.
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


class PatientSocket(WebSocketsSansIOProtocol):
    """Closes what is no WebSocket, which uvicorn leaves open for good, and bounds what one takes.

    Who does not read is not read from either, or pongs would pile up; a message has so many parts at most, since
    empty ones do not count as bytes.
    """

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if not self.handshake_initiated:  # the head comes whole, so this was none
            self.transport.write(_refusal("400 Bad Request"))
            self.transport.close()

    def handle_cont(self, event: Frame) -> None:
        super().handle_cont(event)
        if len(self.frames) > PARTS and not self.close_sent:
            self.conn.send_close(1009, f"more than {PARTS} parts")
            self.handle_parser_exception()

    def pause_writing(self) -> None:
        super().pause_writing()
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        super().resume_writing()
        if not self.read_paused:
            self.transport.resume_reading()

    async def receive(self) -> ASGIReceiveEvent:
        message = await super().receive()
        if not self.writable.is_set():
            self.transport.pause_reading()
        return message

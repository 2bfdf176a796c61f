"""uvicorn's HTTP and WebSocket protocols with limits for which uvicorn has no settings.

They override methods that are not part of uvicorn's public interface, so pyproject.toml pins its version. uvicorn's
``limit_concurrency`` is not equivalent: it counts neither WebSockets nor connections without a request.
"""

import asyncio

from uvicorn._types import ASGIReceiveEvent
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

HEAD_TIMEOUT = 15.0  # s from the first byte of a request to the end of its head
UNREAD_TIMEOUT = 60_000  # ms without acknowledgement of sent data after which the system closes a connection
MAX_CONNECTIONS = 512  # including WebSockets
MAX_FRAMES = 1024  # of one message
MAX_HEAD = 32 << 10  # bytes of a request line with headers


def _refusal(status: str) -> bytes:
    return f"HTTP/1.1 {status}\r\nconnection: close\r\ncontent-length: 0\r\n\r\n".encode()


class HTTPProtocol(H11Protocol):
    """Closes connections beyond the limit, and those whose request head is not complete in time."""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._start_timer()
        if len(self.connections) > MAX_CONNECTIONS:
            transport.write(_refusal("503 Service Unavailable"))
            transport.close()

    def data_received(self, data: bytes) -> None:
        if self._deadline is None and self._is_idle():
            self._start_timer()
        super().data_received(data)
        # After an upgrade, the transport's protocol is the WebSocket's.
        if self._deadline is not None and (not self._is_idle() or self.transport.get_protocol() is not self):
            self._deadline.cancel()
            self._deadline = None

    def connection_lost(self, exc: Exception | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        super().connection_lost(exc)

    def _start_timer(self) -> None:
        self._deadline = self.loop.call_later(HEAD_TIMEOUT, self.transport.close)

    def _is_idle(self) -> bool:
        """Whether no request is being processed."""
        return self.cycle is None or self.cycle.response_complete


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """Closes failed handshakes, which uvicorn leaves open, and bounds the memory of a connection.

    While a client does not read, nothing is read from it, since pongs would accumulate. The number of frames of a
    message is limited, since empty frames do not count towards its size.
    """

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if not self.handshake_initiated:  # the complete head is in the first call
            self.transport.write(_refusal("400 Bad Request"))
            self.transport.close()

    def handle_cont(self, event: Frame) -> None:
        super().handle_cont(event)
        if len(self.frames) > MAX_FRAMES and not self.close_sent:
            self.conn.send_close(1009, f"more than {MAX_FRAMES} frames")
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

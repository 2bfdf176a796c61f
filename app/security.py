"""The guard around the whole server: who may talk to it, and what a page from it may do.

The server is one person's, on the loopback interface, yet any web page that this person visits can send requests
there. Three checks close that door: the Host must be a name we answer to (against DNS rebinding), whatever can change
something must come from our own page (Origin), and the browser is told to keep our pages to themselves (headers).
"""

from __future__ import annotations

import json
from collections.abc import Iterable

from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK = frozenset({"localhost", "127.0.0.1", "[::1]"})
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})

PAGE_POLICY = (
    "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; worker-src 'self' blob:; frame-src 'self'; "
    "frame-ancestors 'self'; object-src 'none'; base-uri 'none'; form-action 'self'"
)
# viser's client is one HTML file whose script unpacks itself, and whose socket lives in a worker made from a blob.
SCENE_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' data: blob:; worker-src 'self' blob: data:; frame-src 'none'; "
    "frame-ancestors 'self'; object-src 'none'; base-uri 'none'; form-action 'none'"
)
HEADERS = {
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"cache-control": b"no-cache",  # revalidate by ETag, unless the answer says otherwise
}


class Guard:
    """ASGI application that lets through what is allowed and adds the security headers to every answer.

    Args:
        app: the application behind the guard; its WebSockets are guarded too.
        hosts: names answered to beside the loopback's, without port (any port is allowed: think of ``ssh -L``).
    """

    def __init__(self, app: ASGIApp, hosts: Iterable[str] = ()) -> None:
        self.app = app
        self.hosts = LOOPBACK | {_bracketed(host.lower()) for host in hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        problem = self.problem(scope)
        if problem is None:
            await self.app(scope, receive, _with_headers(scope, send))
        else:
            await _refuse(scope, receive, send, problem)

    def problem(self, scope: Scope) -> str | None:
        """Why this request is refused, in one line, or None."""
        headers = [(name.lower(), value.decode("latin-1").strip().lower()) for name, value in scope["headers"]]
        hosts = [value for name, value in headers if name == b"host"]
        if len(hosts) != 1:
            return "The request must have one Host header."
        host = hosts[0]
        if _name(host) not in self.hosts:
            return f"Host {host!r} is not answered here. Allowed: {', '.join(sorted(self.hosts))} (any port)."
        if scope["type"] == "http" and scope["method"] in SAFE_METHODS:
            return None
        origins = [value for name, value in headers if name == b"origin"]
        if origins not in ([f"http://{host}"], [f"https://{host}"]):
            shown = ", ".join(origins) or "none"
            return f"Origin must be this server's own, http://{host}; the request's is {shown}."
        return None


def _name(host: str) -> str:
    """``localhost:8000`` -> ``localhost``; ``[::1]:8000`` -> ``[::1]``."""
    return host.partition("]")[0] + "]" if host.startswith("[") else host.partition(":")[0]


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def _with_headers(scope: Scope, send: Send) -> Send:
    policy = SCENE_POLICY if scope["path"].startswith("/scene/") else PAGE_POLICY
    extra = HEADERS | {b"content-security-policy": policy.encode()}

    async def guarded(message: Message) -> None:
        if message["type"] == "http.response.start":
            present = list(message.get("headers", ()))
            names = {name.lower() for name, _ in present}
            message["headers"] = present + [(n, v) for n, v in extra.items() if n not in names]
        await send(message)

    return guarded


async def _refuse(scope: Scope, receive: Receive, send: Send, problem: str) -> None:
    body = json.dumps({"error": problem}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    prefix = ""
    if scope["type"] == "websocket":
        await receive()
        if "websocket.http.response" not in scope.get("extensions", {}):
            await send({"type": "websocket.close", "code": 1008, "reason": problem[:120]})
            return
        prefix = "websocket."
    start = {"type": f"{prefix}http.response.start", "status": 403, "headers": headers}
    await _with_headers(scope, send)(start)
    await send({"type": f"{prefix}http.response.body", "body": body})

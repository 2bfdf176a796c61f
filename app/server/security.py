"""The guard around the whole server: who may talk to it, and what a page from it may do. docs/security.md says why.

By default the server is one person's, on the loopback interface, yet any web page that this person visits can send
requests there. So the Host must be a name we answer to (against DNS rebinding), whatever can change something must come
from our own page (Origin), and the browser is told to keep our pages to themselves (headers). Where others can reach
the server, each request must also show that its sender had the token (``app/server/auth.py``).
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from beliefscope.app.server.auth import (
    LOOPBACK,
    OPEN,
    Access,
    SignIn,
    TooMany,
    is_address,
    onward_page,
    sign_in_page,
    token_in,
    without_token,
)

HOST = re.compile(r"(?P<name>\[[^\[\]]*\]|[^:\[\]]*)(:\d{0,5})?")
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
WITHOUT_TOKEN = frozenset({"/healthz"})
VIEWING = frozenset({"POST /api/views", "POST /api/recordings"})
"""What is asked for by who only looks: a view, and the recording that the Rerun viewer shows, if it is there."""
READ_ONLY = "This server is read-only: it shows, and nothing on it can be changed."

MAX_BODY = 1 << 20  # bytes of a request that is not an upload
UPLOAD = re.compile(r"PUT /api/recordings/.*")
"""What sends files, of which the route itself keeps count."""
PATIENCE = 30.0  # s that the next part of a body may take

PAGE_POLICY = (
    "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; worker-src 'self' blob:; frame-src 'self'; "
    "frame-ancestors 'none'; object-src 'none'; base-uri 'none'; form-action 'self'"
)
# viser's client is one HTML file whose script unpacks itself, and whose socket lives in a worker made from a blob.
SCENE_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' data: blob:; worker-src 'self' blob: data:; frame-src 'none'; "
    "frame-ancestors 'self'; object-src 'none'; base-uri 'none'; form-action 'none'"
)
# Numbers, scripts and files: where a browser is led to show one as a page, it is an inert one.
DATA_POLICY = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'; sandbox"
UNUSED = ("accelerometer", "camera", "display-capture", "geolocation", "gyroscope", "hid", "magnetometer", "microphone")
HEADERS = {
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"origin-agent-cluster": b"?1",
    b"permissions-policy": ", ".join(f"{name}=()" for name in (*UNUSED, "midi", "payment", "serial", "usb")).encode(),
    b"cache-control": b"no-cache",  # revalidate by ETag, unless the answer says otherwise
}
log = logging.getLogger("beliefscope.app")


@dataclass(frozen=True)
class Reply:
    """An answer of the guard's own. page: HTML instead of the reason as JSON."""

    status: int
    reason: str
    headers: Mapping[str, str] = field(default_factory=dict)
    page: str = ""


class Guard:
    """ASGI application that lets through what is allowed and adds the security headers to every answer.

    Args:
        app: the application behind the guard; its WebSockets are guarded too.
        hosts: names answered to beside the loopback's, without port (any port is allowed: think of ``ssh -L``).
        access: what has to be brought, and whether anything may be changed. With a token, a Host may also be any IP
            address: none can be rebound, and all of the machine's are meant.
    """

    def __init__(self, app: ASGIApp, hosts: Iterable[str] = (), access: Access = OPEN) -> None:
        self.app = app
        self.hosts = frozenset(_bracketed(host.lower()) for host in (*LOOPBACK, *hosts))
        self.read_only = access.read_only
        self.sign_in = SignIn(access.token) if access.token else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        answer = _Answer(scope, send)
        reply = self.reply(scope)
        if reply is not None:
            if reply.status >= 400:
                about = {"status": reply.status, "path": scope["path"], "client": _address(scope)}
                log.warning("refused: %s", reply.reason, extra={"event": about})
            await _answer(scope, receive, answer.send, reply)
            return
        try:
            await self.app(scope, _bounded(scope, receive), answer.send)
        except Exception as error:
            mark = secrets.token_hex(4)
            log.exception("failed: %s", error, extra={"event": {"error": mark, "path": scope["path"]}})
            if answer.begun or scope["type"] == "websocket":
                raise
            await _answer(scope, receive, answer.send, Reply(500, f"{error or type(error).__name__} (error {mark})"))

    def reply(self, scope: Scope) -> Reply | None:
        """Why this request is not passed on, or None."""
        headers = [(name.lower(), value.decode("latin-1").strip()) for name, value in scope["headers"]]
        hosts = [value.lower() for name, value in headers if name == b"host"]
        if len(hosts) != 1:
            return Reply(403, "The request must have one Host header.")
        host = hosts[0]
        known = ", ".join(sorted(self.hosts))
        if _name(host) not in self.hosts and not (self.sign_in and is_address(_name(host))):
            return Reply(403, f"Host {host!r} is not answered here. Allowed: {known} (any port).")
        if scope["type"] == "http" and _from_elsewhere(headers):
            return Reply(403, "A page of another site asked for this. It may lead here, but use nothing.")
        bearer = next(filter(None, (_bearer(value) for name, value in headers if name == b"authorization")), "")
        if self.sign_in and scope["path"] not in WITHOUT_TOKEN:
            cookies = "; ".join(value for name, value in headers if name == b"cookie")
            reply = self._unknown(self.sign_in, scope, host, bearer, cookies)
            if reply is not None:
                return reply
        if scope["type"] == "http" and scope["method"] in SAFE_METHODS:
            return None
        origins = [value.lower() for name, value in headers if name == b"origin"]
        # A browser sends no Authorization of itself: what has the token there and no Origin is a script.
        by_script = self.sign_in is not None and bearer and not origins
        if origins not in ([f"http://{host}"], [f"https://{host}"]) and not by_script:
            shown = ", ".join(origins) or "none"
            return Reply(403, f"Origin must be this server's own, http://{host}; the request's is {shown}.")
        if self.read_only and scope["type"] == "http" and f"{scope['method']} {scope['path']}" not in VIEWING:
            return Reply(403, READ_ONLY)
        return None

    def _unknown(self, sign_in: SignIn, scope: Scope, host: str, bearer: str, cookies: str) -> Reply | None:
        """How who shows no sign of having had the token is answered; who brings it to the page is given the cookie."""
        opens = scope["type"] == "http" and scope["method"] in ("GET", "HEAD") and scope["path"] == "/"
        query = scope.get("query_string", b"").decode("latin-1")
        brought = bearer or (token_in(query) if opens else "")
        stay = {"cache-control": "no-store"}
        try:
            if not brought or not sign_in.accepts(brought, _address(scope)):
                if not bearer and sign_in.remembers(host, cookies):
                    return Reply(303, "", {"location": without_token(query)}) if brought else None
                reason = "The token is not right." if brought else "This server asks for a token."
                reason += " Open the link that `beliefscope serve` printed, or give the token as it prints it."
                asks = stay | {"www-authenticate": "Bearer"}
                return Reply(401, reason, asks, sign_in_page(reason, without_token(query)) if opens else "")
        except TooMany as error:
            wait = f"{max(1.0, error.args[0]):.0f}"
            reason = f"Too many wrong tokens came from this address; try again in {wait} s."
            page = sign_in_page(reason, without_token(query)) if opens else ""
            return Reply(429, reason, stay | {"retry-after": wait}, page)
        if bearer:
            return None
        onward = onward_page(without_token(query))
        return Reply(200, "", stay | {"set-cookie": sign_in.cookie(host)}, onward)


def kept_file(folder: Path, name: str) -> Path | None:
    """A file in the folder, by its path from there; None where there is none, or a name or link leads out of it."""
    try:
        path = (folder / name).resolve(strict=True)
    except (OSError, ValueError, RuntimeError):  # not there; a null byte; links in a circle
        return None
    return path if path.is_file() and path.is_relative_to(folder.resolve()) else None


def _bearer(authorization: str) -> str:
    scheme, _, token = authorization.partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


def _address(scope: Scope) -> str:
    client = scope.get("client")
    return client[0] if client else ""


def _name(host: str) -> str:
    """``localhost:8000`` -> ``localhost``; ``[::1]:8000`` -> ``[::1]``; what is not like these as it is."""
    found = HOST.fullmatch(host)
    return found["name"] if found else host


def _from_elsewhere(headers: Iterable[tuple[bytes, str]]) -> bool:
    """Whether a browser asks for a page of another site, or of another server of this machine, and not for its user.

    What is asked for is computed and kept, though such a page could not read it. Browsers say so on the loopback
    interface and over https; elsewhere the cookie, which they do not send then, is what guards.
    """
    said = dict(headers)
    leads = (said.get(b"sec-fetch-mode"), said.get(b"sec-fetch-dest")) == ("navigate", "document")
    return said.get(b"sec-fetch-site") in ("cross-site", "same-site") and not leads


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def _bounded(scope: Scope, receive: Receive) -> Receive:
    """Takes a body of so many bytes, each part of it in so many seconds. Raises HTTPException for more."""
    if scope["type"] != "http":
        return receive
    upload = UPLOAD.fullmatch(f"{scope['method']} {scope['path']}")
    size, more = 0, True

    async def bounded() -> Message:
        nonlocal size, more
        if not more:
            return await receive()  # until the browser goes
        try:
            message = await asyncio.wait_for(receive(), PATIENCE)
        except TimeoutError:
            raise HTTPException(408, f"The request's body did not come within {PATIENCE:.0f} s.") from None
        size, more = size + len(message.get("body", b"")), bool(message.get("more_body", False))
        if size > MAX_BODY and not upload:
            raise HTTPException(413, f"The request's body is larger than {MAX_BODY} bytes.")
        return message

    return bounded


class _Answer:
    """What is sent, with the security headers; ``begun`` once anything was."""

    def __init__(self, scope: Scope, send: Send) -> None:
        self.begun = False
        self._send = send
        scene = scope["path"].startswith("/scene/")
        policy = SCENE_POLICY if scene else PAGE_POLICY if scope["path"] == "/" else DATA_POLICY
        framed = b"SAMEORIGIN" if scene else b"DENY"
        self._extra = HEADERS | {b"content-security-policy": policy.encode(), b"x-frame-options": framed}

    async def send(self, message: Message) -> None:
        self.begun = True
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            present = list(message.get("headers", ()))
            names = {name.lower() for name, _ in present}
            message["headers"] = present + [(n, v) for n, v in self._extra.items() if n not in names]
        await self._send(message)


async def _answer(scope: Scope, receive: Receive, send: Send, reply: Reply) -> None:
    body = reply.page.encode() if reply.page else json.dumps({"error": reply.reason}).encode()
    kind = "text/html; charset=utf-8" if reply.page else "application/json"
    said = {"content-type": kind, "content-length": str(len(body)), **reply.headers}
    headers = [(name.encode(), value.encode("latin-1")) for name, value in said.items()]
    prefix = ""
    if scope["type"] == "websocket":
        await receive()
        if "websocket.http.response" not in scope.get("extensions", {}):
            reason = reply.reason or HTTPStatus(reply.status).phrase
            await send({"type": "websocket.close", "code": 1008, "reason": reason[:120]})
            return
        prefix = "websocket."
    await send({"type": f"{prefix}http.response.start", "status": reply.status, "headers": headers})
    await send({"type": f"{prefix}http.response.body", "body": b"" if scope.get("method") == "HEAD" else body})

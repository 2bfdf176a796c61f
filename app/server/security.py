"""Access control and security headers for all requests; docs/security.md explains the reasons.

A server on the loopback interface can receive requests from any web page that its user visits. Therefore the Host must
be known (against DNS rebinding), requests that can change something need the server's own Origin, and headers restrict
the use of responses. If others can reach the server, requests must also be authenticated (``app/server/auth.py``).
"""

import asyncio
import logging
import re
import secrets
from collections.abc import Iterable, Mapping

from starlette.datastructures import URL, Headers, MutableHeaders, QueryParams
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from beliefscope.app.protocol.messages import READ_ONLY
from beliefscope.app.server.auth import (
    LOOPBACK,
    OPEN,
    Access,
    SignIn,
    TooManyAttempts,
    is_address,
    redirect_page,
    sign_in_page,
)

HOST = re.compile(r"(?P<name>\[[^\[\]]*\]|[^:\[\]]*)(:\d{0,5})?")
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
WITHOUT_TOKEN = frozenset({"/healthz"})
READ_ONLY_ALLOWED = frozenset({"POST /api/views", "POST /api/recordings"})
"""Allowed on read-only servers: opening a view, and looking up the recording for the Rerun viewer."""

MAX_BODY = 1 << 20  # bytes, except uploads
UPLOAD = re.compile(r"PUT /api/recordings/.*")
"""Uploads; the route checks their size."""
BODY_TIMEOUT = 30.0  # s between two chunks of a body

PAGE_POLICY = (
    "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; worker-src 'self' blob:; frame-src 'self'; "
    "frame-ancestors 'none'; object-src 'none'; base-uri 'none'; form-action 'self'"
)
# viser's client is one HTML file with a self-extracting script; its socket runs in a worker created from a blob.
SCENE_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' data: blob:; worker-src 'self' blob: data:; frame-src 'none'; "
    "frame-ancestors 'self'; object-src 'none'; base-uri 'none'; form-action 'none'"
)
# For data, scripts and files: displayed as a page, they are inert.
DATA_POLICY = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'; sandbox"
UNUSED_FEATURES = (
    "accelerometer camera display-capture geolocation gyroscope hid magnetometer microphone midi payment serial usb"
)
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "origin-agent-cluster": "?1",
    "permissions-policy": ", ".join(f"{name}=()" for name in UNUSED_FEATURES.split()),
    "cache-control": "no-cache",  # revalidate by ETag; responses may override this
}
log = logging.getLogger("beliefscope.app")


class Guard:
    """ASGI middleware that checks all requests and WebSockets and adds security headers to all responses.

    hosts: allowed host names in addition to the loopback's, with any port (``ssh -L`` changes it). access: required
    token and permissions. With a token, the Host may also be any IP address.
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
        response = _Response(scope, send)
        reply = self.reply(scope)
        if reply is not None:
            await reply(scope, receive, response.send)
            return
        try:
            await self.app(scope, _limit_body(scope, receive), response.send)
        except Exception as error:
            id = secrets.token_hex(4)
            log.exception("failed: %s", error, extra={"event": {"error": id, "path": scope["path"]}})
            if response.started or scope["type"] == "websocket":
                raise
            failure = JSONResponse({"error": f"{error or type(error).__name__} (error {id})"}, 500)
            await failure(scope, receive, response.send)

    def reply(self, scope: Scope) -> Response | None:
        """The response to a request or WebSocket that is refused or signs in, or None if it is allowed."""
        headers = Headers(scope=scope)
        hosts = [value.lower() for value in headers.getlist("host")]
        if len(hosts) != 1:
            return _refusal(scope, 403, "The request must have one Host header.")
        host = hosts[0]
        if _name(host) not in self.hosts and not (self.sign_in and is_address(_name(host))):
            allowed = ", ".join(sorted(self.hosts))
            return _refusal(scope, 403, f"Host {host!r} is not allowed. Allowed: {allowed} (any port).")
        if scope["type"] == "http" and _is_cross_site(headers):
            return _refusal(scope, 403, "The request comes from a page of another site.")
        bearer = next(filter(None, map(_bearer, headers.getlist("authorization"))), "")
        if self.sign_in and scope["path"] not in WITHOUT_TOKEN:
            reply = self._authenticate(self.sign_in, scope, host, bearer, "; ".join(headers.getlist("cookie")))
            if reply is not None:
                return reply
        if scope["type"] == "http" and scope["method"] in SAFE_METHODS:
            return None
        origins = [value.lower() for value in headers.getlist("origin")]
        # Browsers do not send Authorization by themselves, so this request comes from a script.
        is_script = self.sign_in is not None and bearer and not origins
        if origins not in ([f"http://{host}"], [f"https://{host}"]) and not is_script:
            origin = ", ".join(origins) or "none"
            return _refusal(scope, 403, f"Origin must be http://{host}; the request has {origin}.")
        if self.read_only and scope["type"] == "http" and f"{scope['method']} {scope['path']}" not in READ_ONLY_ALLOWED:
            return _refusal(scope, 403, READ_ONLY)
        return None

    def _authenticate(self, sign_in: SignIn, scope: Scope, host: str, bearer: str, cookies: str) -> Response | None:
        """The response to an unauthenticated request, or the cookie for a valid token; None if authenticated."""
        is_page = scope["type"] == "http" and scope["method"] in ("GET", "HEAD") and scope["path"] == "/"
        query = scope.get("query_string", b"").decode("latin-1")
        token = bearer or (QueryParams(query).get("token", "") if is_page else "")
        address = str(URL(f"/?{query}").remove_query_params("token"))
        uncached = {"cache-control": "no-store"}
        try:
            if not token or not sign_in.accepts(token, _address(scope)):
                if not bearer and sign_in.has_cookie(host, cookies):
                    return Response(status_code=303, headers={"location": address}) if token else None
                reason = "The token is wrong." if token else "This server requires a token."
                reason += " Open the link that `beliefscope serve` printed, or enter the token."
                challenge = uncached | {"www-authenticate": "Bearer"}
                return _refusal(scope, 401, reason, challenge, sign_in_page(reason, address) if is_page else "")
        except TooManyAttempts as error:
            wait = f"{max(1.0, error.args[0]):.0f}"
            reason = f"Too many wrong tokens from this address; try again in {wait} s."
            page = sign_in_page(reason, address) if is_page else ""
            return _refusal(scope, 429, reason, uncached | {"retry-after": wait}, page)
        if bearer:
            return None
        return HTMLResponse(redirect_page(address), headers=uncached | {"set-cookie": sign_in.cookie(host)})


def _refusal(
    scope: Scope, status: int, reason: str, headers: Mapping[str, str] | None = None, page: str = ""
) -> Response:
    """The response to a refused request or WebSocket, which is logged. page: HTML instead of the reason as JSON."""
    event = {"status": status, "path": scope["path"], "client": _address(scope)}
    log.warning("refused: %s", reason, extra={"event": event})
    if page:
        return HTMLResponse(page, status, headers)
    return JSONResponse({"error": reason}, status, headers)


def _bearer(authorization: str) -> str:
    scheme, _, token = authorization.partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


def _address(scope: Scope) -> str:
    client = scope.get("client")
    return client[0] if client else ""


def _name(host: str) -> str:
    """Without the port: ``localhost:8000`` -> ``localhost``; ``[::1]:8000`` -> ``[::1]``."""
    match = HOST.fullmatch(host)
    return match["name"] if match else host


def _is_cross_site(headers: Headers) -> bool:
    """Whether a page of another site or port sends the request, other than a link that the user follows.

    Such a page cannot read the response, but the request would still consume resources. Browsers send these headers on
    the loopback interface and over https; elsewhere the SameSite cookie protects.
    """
    is_link = (headers.get("sec-fetch-mode"), headers.get("sec-fetch-dest")) == ("navigate", "document")
    return headers.get("sec-fetch-site") in ("cross-site", "same-site") and not is_link


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def _limit_body(scope: Scope, receive: Receive) -> Receive:
    """Limit the size of a body and the time between its chunks. Raises HTTPException."""
    if scope["type"] != "http":
        return receive
    upload = UPLOAD.fullmatch(f"{scope['method']} {scope['path']}")
    size, more = 0, True

    async def limited() -> Message:
        nonlocal size, more
        if not more:
            return await receive()  # returns when the client disconnects
        try:
            message = await asyncio.wait_for(receive(), BODY_TIMEOUT)
        except TimeoutError:
            raise HTTPException(408, f"The request body was not received within {BODY_TIMEOUT:.0f} s.") from None
        size, more = size + len(message.get("body", b"")), bool(message.get("more_body", False))
        if size > MAX_BODY and not upload:
            raise HTTPException(413, f"The request body is larger than {MAX_BODY} bytes.")
        return message

    return limited


class _Response:
    """Adds security headers to a response. started: whether anything has been sent."""

    def __init__(self, scope: Scope, send: Send) -> None:
        self.started = False
        self._send = send
        scene = scope["path"].startswith("/scene/")
        self._extra = HEADERS | {
            "content-security-policy": SCENE_POLICY if scene else PAGE_POLICY if scope["path"] == "/" else DATA_POLICY,
            "x-frame-options": "SAMEORIGIN" if scene else "DENY",
        }

    async def send(self, message: Message) -> None:
        self.started = True
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            headers = MutableHeaders(scope=message)
            for name, value in self._extra.items():
                headers.setdefault(name, value)
        await self._send(message)

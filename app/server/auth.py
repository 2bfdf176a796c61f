"""Authentication with a token, for servers that others can reach.

A script sends the token in the header ``Authorization: Bearer TOKEN`` of each request. A browser sends it once, as
``/?token=TOKEN``, the link that ``serve`` prints. It receives a cookie and is redirected to the address without the
token, which thus appears in no bookmark or Referer. The cookie is valid until the server stops.
"""

import hmac
import ipaddress
import secrets
import socket
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from html import escape
from urllib.parse import urlencode

from starlette.requests import cookie_parser

from beliefscope.app.server.plain_pages import plain_page
from beliefscope.datasets.errors import BadInput

VARIABLE = "BELIEFSCOPE_TOKEN"
MIN_LENGTH = 16  # characters of a user-defined token
SAFE_LENGTH = 32  # characters of a token that cannot be guessed; generated tokens have more
MAX_ATTEMPTS, PERIOD = 10, 60.0  # wrong tokens per address and s
MAX_ADDRESSES = 1000  # for which wrong tokens are counted
LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
EVERYWHERE = frozenset({"0.0.0.0", "::"})


@dataclass(frozen=True)
class Access:
    """Access to a server. token: required of all clients; empty for none. read_only: whether changes are refused."""

    token: str = field(default="", repr=False)
    read_only: bool = False

    def link(self, url: str) -> str:
        """The link that opens the page of the server at ``url``."""
        return f"{url}?{urlencode({'token': self.token})}" if self.token else url


OPEN = Access()
"""No restrictions, for a server on the loopback interface."""


def token_for(host: str, required: bool, environment: Mapping[str, str]) -> str:
    """The token of a server on ``host``; empty for the loopback interface if none is required.

    Raises BadInput for a token in the environment that is too short.
    """
    token = environment.get(VARIABLE, "")
    if token and (len(token) < MIN_LENGTH or not token.isprintable() or not token.isascii() or " " in token):
        raise BadInput(f"{VARIABLE} has {len(token)} characters; expected at least {MIN_LENGTH}, ASCII, without spaces")
    if token or (host in LOOPBACK and not required):
        return token
    return secrets.token_urlsafe(32)


def host_names(host: str) -> tuple[str, ...]:
    """Names of a server that listens on ``host``; the first one is printed."""
    return (socket.gethostname(), host) if host in EVERYWHERE else (host,)


def is_address(host: str) -> bool:
    """Whether the host is an IP address, with or without brackets; unlike names, those cannot be rebound by DNS."""
    try:
        ipaddress.ip_address(host.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True


class TooManyAttempts(Exception):
    """Too many wrong tokens from one address. Argument: s to wait."""


class SignIn:
    """Checks tokens and cookies. token: not empty. clock: in s, monotonic."""

    def __init__(self, token: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._token = token.encode()
        self._cookie = secrets.token_urlsafe(32)
        self._clock = clock
        self._attempts: OrderedDict[str, deque[float]] = OrderedDict()

    def has_cookie(self, host: str, cookies: str) -> bool:
        """Whether the cookies of a request to ``host`` contain the valid one."""
        # Not http.cookies, which drops all cookies if one, possibly of another server, is malformed.
        value = cookie_parser(cookies).get(_cookie_name(host), "")
        return hmac.compare_digest(value.encode(), self._cookie.encode())

    def accepts(self, token: str, address: str) -> bool:
        """Whether the token is correct. Raises TooManyAttempts after too many wrong ones from ``address``.

        The limit applies to short tokens only: clients that share the owner's address cannot lock the owner out of a
        server whose token cannot be guessed.
        """
        correct = hmac.compare_digest(token.encode(), self._token)
        if correct and len(self._token) >= SAFE_LENGTH:
            return True
        recent = [when for when in self._attempts.get(address, ()) if when > self._clock() - PERIOD]
        if len(recent) >= MAX_ATTEMPTS:
            raise TooManyAttempts(recent[0] + PERIOD - self._clock())
        if correct:
            self._attempts.pop(address, None)
            return True
        self._attempts.setdefault(address, deque(maxlen=MAX_ATTEMPTS)).append(self._clock())
        self._attempts.move_to_end(address)
        while len(self._attempts) > MAX_ADDRESSES:
            self._attempts.popitem(last=False)
        return False

    def cookie(self, host: str) -> str:
        """``Set-Cookie`` header for a request to ``host``; hidden from scripts and from other sites."""
        return f"{_cookie_name(host)}={self._cookie}; Path=/; HttpOnly; SameSite=Strict"


def _cookie_name(host: str) -> str:
    # Browsers ignore the port of cookies; without it in the name, servers on one machine would overwrite each other's.
    port = host.rpartition(":")[2] if ":" in host and not host.endswith("]") else "80"
    return f"beliefscope-{port}"


def redirect_page(address: str) -> str:
    """HTML that redirects to an address of this server.

    Not an HTTP redirect: if the link is on another site, the browser would follow that without the SameSite cookie.
    """
    return plain_page(
        head=f'<meta http-equiv="refresh" content="0;url={escape(address)}">',
        body=f'<p>Signed in. <a href="{escape(address)}">Continue</a></p>',
    )


def sign_in_page(problem: str, address: str) -> str:
    """HTML form for the token, with a link to an address of this server.

    Browsers do not send the SameSite cookie when they follow a link from another page, such as a displayed report;
    from this page they do.
    """
    return plain_page(
        f"<p>{escape(problem)}</p>"
        '<form action="/" method="get"><label>Token <input name="token" type="password" autocomplete="off" required '
        'autofocus></label> <button type="submit">Sign in</button></form>'
        f'<p>Already signed in? <a href="{escape(address)}">Continue</a>.</p>',
    )

"""Who is let in where the server is not one person's alone: a token, told once as a link, and what it opens.

A script brings it in the header ``Authorization: Bearer TOKEN`` of each request, a browser once, as ``/?token=TOKEN``,
the link that ``serve`` prints. The browser is given a cookie for it and sent on to the address without the token, so
that it stays in no bookmark or Referer. The cookie is of this run of the server alone.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from html import escape
from urllib.parse import parse_qsl, urlencode

from beliefscope.datasets.errors import BadInput

VARIABLE = "BELIEFSCOPE_TOKEN"
SHORTEST = 16  # characters of a token of the user's own
BEYOND_GUESSING = 32  # characters of a token that nobody need be kept from guessing, as ours is
TRIES, PERIOD = 10, 60.0  # wrong tokens from one address in so many s, after which it has to wait
ADDRESSES = 1000  # whose wrong tokens are remembered
LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
EVERYWHERE = frozenset({"0.0.0.0", "::"})


@dataclass(frozen=True)
class Access:
    """What whoever asks has to bring, and what they may do.

    Attributes:
        token: what has to be brought; nothing where it is empty. read_only: nothing can be changed, only looked at.
    """

    token: str = field(default="", repr=False)
    read_only: bool = False

    def link(self, url: str) -> str:
        """The address that opens the page of this server, whose address this is."""
        return f"{url}?{urlencode({'token': self.token})}" if self.token else url


OPEN = Access()
"""Whoever can reach the server may do everything: right for one person's machine."""


def token_for(host: str, demanded: bool, environment: Mapping[str, str]) -> str:
    """The token of a server that listens on ``host``; empty for the loopback interface where none is demanded.

    Raises BadInput for one in the environment that could be guessed.
    """
    given = environment.get(VARIABLE, "")
    if given and (len(given) < SHORTEST or not given.isprintable() or not given.isascii() or " " in given):
        raise BadInput(f"{VARIABLE} has {len(given)} characters, expected {SHORTEST} or more, ASCII and without spaces")
    if given or (host in LOOPBACK and not demanded):
        return given
    return secrets.token_urlsafe(32)


def names_of(host: str) -> tuple[str, ...]:
    """Names by which a server that listens on ``host`` is reached, the one to be printed first."""
    return (socket.gethostname(), host) if host in EVERYWHERE else (host,)


def is_address(host: str) -> bool:
    """Whether it is an IP address, with or without brackets, and no name that someone's DNS could turn elsewhere."""
    try:
        ipaddress.ip_address(host.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True


class TooMany(Exception):
    """From this address there were too many wrong tokens. Holds the s that it has to wait."""


class SignIn:
    """Tells who brings the token, or had brought it.

    Args:
        token: not empty. clock: monotonic s.
    """

    def __init__(self, token: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._token = token.encode()
        self._cookie = secrets.token_urlsafe(32)
        self._clock = clock
        self._wrong: OrderedDict[str, deque[float]] = OrderedDict()

    def remembers(self, host: str, cookies: str) -> bool:
        """Whether a browser that calls the server ``host`` sends the cookie it was given."""
        # Not http.cookies: it drops all of them where another server of this host has set one that it cannot read.
        pairs = (part.strip().partition("=") for part in cookies.split(";"))
        found = {name: value for name, _, value in pairs}.get(_cookie_name(host), "")
        return hmac.compare_digest(found.encode(), self._cookie.encode())

    def accepts(self, brought: str, address: str) -> bool:
        """Whether this is the token. Raises TooMany where ``address`` brought wrong ones too often.

        Then a right one that could be guessed is not taken either. One beyond guessing is: whoever shares an address,
        behind a proxy or on this machine, cannot lock out its owner.
        """
        right = hmac.compare_digest(brought.encode(), self._token)
        if right and len(self._token) >= BEYOND_GUESSING:
            return True
        wrong = self._wrong.get(address, ())
        recent = [when for when in wrong if when > self._clock() - PERIOD]
        if len(recent) >= TRIES:
            raise TooMany(recent[0] + PERIOD - self._clock())
        if right:
            self._wrong.pop(address, None)
            return True
        self._wrong.setdefault(address, deque(maxlen=TRIES)).append(self._clock())
        self._wrong.move_to_end(address)
        while len(self._wrong) > ADDRESSES:
            self._wrong.popitem(last=False)
        return False

    def cookie(self, host: str) -> str:
        """``Set-Cookie`` for who called the server ``host``: hidden from scripts, and not for other sites."""
        return f"{_cookie_name(host)}={self._cookie}; Path=/; HttpOnly; SameSite=Strict"


def _cookie_name(host: str) -> str:
    # Browsers keep cookies by host alone: servers on several ports of one machine would take each other's.
    port = host.rpartition(":")[2] if ":" in host and not host.endswith("]") else "80"
    return f"beliefscope-{port}"


def token_in(query: str) -> str:
    """The token in an address's query; empty where there is none."""
    return dict(parse_qsl(query, keep_blank_values=True)).get("token", "")


def without_token(query: str) -> str:
    """The page's address with the rest of the query."""
    rest = [(key, value) for key, value in parse_qsl(query, keep_blank_values=True) if key != "token"]
    return "/?" + urlencode(rest) if rest else "/"


def onward_page(address: str) -> str:
    """HTML that leads on to an address of ours.

    Not a redirect: where the link stands on another site, the browser would follow one without the cookie, which is
    strictly for our own pages.
    """
    return _PAGE.format(
        head=f'<meta http-equiv="refresh" content="0;url={escape(address)}">',
        body=f'<p>Signed in. <a href="{escape(address)}">Go on</a></p>',
    )


def sign_in_page(problem: str, address: str) -> str:
    """HTML that asks for the token, and leads on to an address of ours.

    A browser that has the cookie leaves it out where a link of another page led to us, of a shown report for one;
    from here it sends it.
    """
    return _PAGE.format(
        head="",
        body=f"<p>{escape(problem)}</p>"
        '<form action="/" method="get"><label>Token <input name="token" type="password" autocomplete="off" required '
        'autofocus></label> <button type="submit">Sign in</button></form>'
        f'<p>If you are signed in already and a link led here: <a href="{escape(address)}">go on</a>.</p>',
    )


_PAGE = (
    '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Beliefscope</title>'
    '<meta name="viewport" content="width=device-width, initial-scale=1">'
    '<meta name="color-scheme" content="light dark">'
    "<style>body{{font:15px/1.5 system-ui,sans-serif;max-width:34rem;margin:18vh auto 0;padding:0 1.5rem}}"
    "input,button{{font:inherit;padding:.3rem .6rem}}</style>{head}</head>"
    "<body><h1>Beliefscope</h1>{body}</body></html>"
)

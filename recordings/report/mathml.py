"""Equations of a report as MathML, which browsers draw without a script, from the little of TeX that ours need."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import escape

LETTERS = ("beta", "sigma", "chi", "pi")
"""TeX and HTML call them the same."""

SIGNS = {
    **{"sum": "&sum;", "propto": "&prop;", "sim": "&sim;", "le": "&le;", "odot": "&#8857;", "top": "&#8868;"},
    **{"quad": "&emsp;", "ln": "ln", "-": "&minus;", "'": "&prime;"},
}
BIG = ("sum",)
"""Their bounds stand below and above."""

TOKEN = re.compile(r"\\text\{[^}]*\}|\\[A-Za-z]+|\d+(?:\.\d+)?|[A-Za-z]|\S")


def mathml(tex: str, block: bool = False) -> str:
    r"""``\frac{}{}``, ``\sqrt{}``, ``\bar{}``, ``\text{}``, ``_``, ``^`` and the names above; block: by itself.

    Raises ValueError for a name or a brace that it does not know: equations are ours, so a test sees all of them.
    """
    tokens = iter(TOKEN.findall(tex))
    inside = _row(tokens, "")
    display = ' display="block"' if block else ""
    return f"<math{display}><mrow>{inside}</mrow></math>"


def _row(tokens: Iterator[str], end: str) -> str:
    """What stands up to the closing ``end``, scripts put on what they follow."""
    made: list[str] = []
    big: list[bool] = []
    scripts: list[dict[str, str]] = []
    for token in tokens:
        if token == end:
            break
        if token in ("_", "^"):
            if not made or token in scripts[-1]:
                raise ValueError(f"nothing that {token!r} could stand on")
            scripts[-1][token] = _atom(next(tokens), tokens)
        else:
            made.append(_atom(token, tokens))
            big.append(token.removeprefix("\\") in BIG)
            scripts.append({})
    else:
        if end:
            raise ValueError(f"{end!r} is missing")
    return "".join(map(_scripted, made, scripts, big))


def _scripted(base: str, scripts: dict[str, str], big: bool) -> str:
    kind = "munderover" if big else "msubsup"
    low, high = scripts.get("_"), scripts.get("^")
    if low and high:
        return f"<{kind}>{base}{low}{high}</{kind}>"
    if low or high:
        tag = {(True, True): "munder", (True, False): "mover"}.get((big, bool(low)), "msub" if low else "msup")
        return f"<{tag}>{base}{low or high}</{tag}>"
    return base


def _atom(token: str, tokens: Iterator[str]) -> str:
    if token == "{":
        return f"<mrow>{_row(tokens, '}')}</mrow>"
    if token.startswith("\\text{"):
        return f"<mtext>{escape(token[6:-1])}</mtext>"
    if token.startswith("\\"):
        return _named(token[1:], tokens)
    if token[0].isdigit():
        return f"<mn>{token}</mn>"
    if token.isalpha():
        return f"<mi>{token}</mi>"
    if token == "}":
        raise ValueError("'}' closes nothing")
    if token in "()":
        return f'<mo stretchy="false">{token}</mo>'
    if token == "|":
        return '<mo stretchy="false" lspace="0.15em" rspace="0.15em">|</mo>'
    return f"<mo>{SIGNS.get(token) or escape(token)}</mo>"


def _named(name: str, tokens: Iterator[str]) -> str:
    if name in LETTERS:
        return f"<mi>&{name};</mi>"
    if name in SIGNS:
        return f"<mo>{SIGNS[name]}</mo>"
    if name == "frac":
        return f"<mfrac>{_atom(next(tokens), tokens)}{_atom(next(tokens), tokens)}</mfrac>"
    if name == "sqrt":
        return f"<msqrt>{_atom(next(tokens), tokens)}</msqrt>"
    if name == "bar":
        return f'<mover accent="true">{_atom(next(tokens), tokens)}<mo>&macr;</mo></mover>'
    raise ValueError(f"\\{name} is not known")

"""Strict JSON reader for untrusted input."""

from __future__ import annotations

import json
from typing import Any, NoReturn


def read_json(text: str | bytes) -> Any:
    """Parse a JSON document that can be serialized again. Raises ValueError, in one line, for any other text.

    Unlike ``json.loads``, rejects NaN, numbers beyond the range of floats, lone surrogates and excessive nesting.
    """
    try:
        document = json.loads(text, parse_constant=_reject, parse_int=_parse_int)
        json.dumps(document, ensure_ascii=False, allow_nan=False).encode()
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except UnicodeEncodeError:
        raise ValueError("it contains a lone surrogate") from None
    return document


def _parse_int(digits: str) -> int:
    number = int(digits)
    try:
        float(number)
    except OverflowError:  # pydantic would convert it to infinity
        raise ValueError(f"a number of {len(digits)} digits is beyond the range of floats") from None
    return number


def _reject(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a JSON number")

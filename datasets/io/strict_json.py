"""JSON that comes from outside: read as it is meant, or refused."""

from __future__ import annotations

import json
from typing import Any, NoReturn


def read_json(text: str | bytes) -> Any:
    """A JSON document that can be written again. Raises ValueError, in one line, for any other text.

    Python's own reader takes NaN, numbers beyond all floats and halves of characters, which nothing after it can send
    on, and gives up in its own way on what is nested too deeply.
    """
    try:
        found = json.loads(text, parse_constant=_refuse, parse_int=_whole)
        json.dumps(found, ensure_ascii=False, allow_nan=False).encode()
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except UnicodeEncodeError:
        raise ValueError("it holds half a character") from None
    return found


def _whole(digits: str) -> int:
    number = int(digits)
    try:
        float(number)
    except OverflowError:  # which pydantic would take as infinity
        raise ValueError(f"a number of {len(digits)} digits is beyond all floats") from None
    return number


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON")

"""What a diagnostic can be asked with: its options as JSON, and from the texts of an address or a command line."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.inspect.diagnostics.base import Entry


def described(entry: Entry) -> dict[str, Any]:
    """An entry as JSON; an option's default is text, empty where there is none to be shown."""
    parameters = inspect.signature(entry.run).parameters
    options = [
        {"name": name, "meaning": meaning, "default": _shown(parameters[name].default)}
        for name, meaning in entry.options.items()
    ]
    return {
        "name": entry.name,
        "title": entry.title,
        "question": entry.question,
        "slow": entry.slow,
        "options": options,
    }


def parse(entry: Entry, texts: Mapping[str, str]) -> dict[str, Any]:
    """The entry's options from texts, as the types that its function takes; an empty one is its default.

    Raises BadInput for an option that the entry does not have, and for a text that its type does not take.
    """
    hints = get_type_hints(entry.run)
    options: dict[str, Any] = {}
    for name, text in texts.items():
        if name not in entry.options:
            raise one_of(f"option of {entry.name}", name, entry.options)
        if not text:
            continue
        try:
            options[name] = TypeAdapter(hints.get(name, str)).validate_strings(text)
        except ValidationError as error:
            said = error.errors()[0]["msg"]
            raise BadInput(f"{entry.name}'s {name!r} is {text!r}: {said}. It is {entry.options[name]}.") from None
    return options


def says_how_far(entry: Entry) -> bool:
    """Whether it takes ``progress``, a function that is told the share done."""
    return "progress" in inspect.signature(entry.run).parameters


def _shown(default: Any) -> str:
    return "" if default in (None, inspect.Parameter.empty) else str(default)

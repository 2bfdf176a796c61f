"""Options of diagnostics: their description as JSON, and their values from query strings or a command line."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.inspect.diagnostics.base import Entry


def describe_entry(entry: Entry) -> dict[str, Any]:
    """An entry as JSON; the default of an option is text, empty if there is none."""
    parameters = inspect.signature(entry.run).parameters
    options = [
        {"name": name, "meaning": meaning, "default": _default_text(parameters[name].default)}
        for name, meaning in entry.options.items()
    ]
    return {name: getattr(entry, name) for name in ("name", "title", "question", "slow")} | {"options": options}


def parse_options(entry: Entry, texts: Mapping[str, str]) -> dict[str, Any]:
    """Convert texts to the types of the entry's options; an empty text selects the default.

    Raises BadInput for an unknown option or an invalid value.
    """
    hints = get_type_hints(entry.run)
    options: dict[str, Any] = {}
    for name, text in texts.items():
        if name not in entry.options:
            raise unknown_name(f"option of {entry.name}", name, entry.options)
        if not text:
            continue
        try:
            options[name] = TypeAdapter(hints.get(name, str)).validate_strings(text)
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
            meaning = entry.options[name]
            raise BadInput(f"option {name!r} of {entry.name} ({meaning}) is {text!r}: {reason}.") from None
    return options


def takes_progress(entry: Entry) -> bool:
    """Whether the entry's function has the argument ``progress``, a callback for the share done."""
    return "progress" in inspect.signature(entry.run).parameters


def _default_text(default: Any) -> str:
    return "" if default in (None, inspect.Parameter.empty) else str(default)

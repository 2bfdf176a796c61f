"""Options of diagnostics from query strings or a command line."""

from collections.abc import Mapping
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.inspect.diagnostics.base import Entry


def parse_options(entry: Entry, texts: Mapping[str, str]) -> dict[str, Any]:
    """Convert texts to the types of the entry's options; an empty text selects the default.

    Raises BadInput for an unknown option or an invalid value.
    """
    hints = get_type_hints(entry.run)
    options: dict[str, Any] = {}
    for name, text in texts.items():
        check_name(f"option of {entry.name}", name, entry.options)
        if not text:
            continue
        try:
            options[name] = TypeAdapter(hints.get(name, str)).validate_strings(text)
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
            meaning = entry.options[name]
            raise BadInput(f"option {name!r} of {entry.name} ({meaning}) is {text!r}: {reason}.") from None
    return options

"""Errors caused by user input."""

from collections.abc import Container
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path

LONG_LIST = 12
"""Names that a reader compares at a glance."""

MAX_LISTED = 60
"""Names of an error. Tables can have thousands of columns."""


class BadInput(ValueError):
    """An error the user can fix: an invalid name, file, shape or value.

    The message is one line with the invalid value and the valid ones. The command line prints it and exits with
    code 2; the page shows it (HTTP 4xx, JSON). Undecodable bytes of a name are shown as ``\\udcff``.

    Attributes:
        advice: a command that helps, which the command line adds; empty if there is none.
    """

    def __init__(self, message: str, advice: str = "") -> None:
        super().__init__(message.encode(errors="backslashreplace").decode())
        self.advice = advice


def check_name(kind: str, name: str, available: Container[str]) -> None:
    """Raise the error of ``unknown_name`` for a name that is not available."""
    if name not in available:
        raise unknown_name(kind, name, available)


def unknown_name(kind: str, name: str, available: object) -> BadInput:
    """Return the error for an unknown name: ``modality 'touch' of task 'door' does not exist. Available: ...``.

    A long list is preceded by the most similar names, and ends after ``MAX_LISTED``.

    Args:
        kind: of the name, optionally with its owner, such as ``modality of task 'door'``.
    """
    names = [str(a) for a in available]  # type: ignore[attr-defined]
    similar = get_close_matches(name, names, n=2) if len(names) > LONG_LIST else []
    hint = f" Did you mean {' or '.join(similar)}?" if similar else ""
    more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
    listed = ", ".join(names[:MAX_LISTED]) or "none"
    noun, *owner = kind.split(" of ", 1)
    title = " of ".join((f"{noun} {name!r}", *owner))
    return BadInput(f"{title} does not exist.{hint} Available: {listed}{more}.")


def type_name(value: object) -> str:
    """The type of a value with its article: ``a Tensor`` or ``an int``."""
    name = type(value).__name__
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def reason_unreadable(path: Path, error: Exception) -> str:
    """Why a file is no readable safetensors file: it is an HDF5 file, or the message of the library's error."""
    with suppress(OSError), path.open("rb") as file:
        if file.read(8) == b"\x89HDF\r\n\x1a\n":
            return "it is an HDF5 file, such as a data set"
    return f"{error!s:.200}"

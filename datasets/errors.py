"""Errors caused by user input."""

from collections.abc import Container


class BadInput(ValueError):
    """An error the user can fix: an invalid name, file, shape or value.

    The message is one line with the invalid value and the valid ones. The command line prints it and exits with
    code 2; the page shows it (HTTP 4xx, JSON). Undecodable bytes of a name are shown as ``\\udcff``.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message.encode(errors="backslashreplace").decode())


def check_name(kind: str, name: str, available: Container[str]) -> None:
    """Raise the error of ``unknown_name`` for a name that is not available."""
    if name not in available:
        raise unknown_name(kind, name, available)


def unknown_name(kind: str, name: str, available: object) -> BadInput:
    """Return the error for an unknown name: ``filter 'crosmodal-pf' does not exist. Available: ...``."""
    names = ", ".join(str(a) for a in available)  # type: ignore[attr-defined]
    return BadInput(f"{kind} {name!r} does not exist. Available: {names or 'none'}.")

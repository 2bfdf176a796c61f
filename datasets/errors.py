"""The one error that is the user's to mend."""


class BadInput(ValueError):
    """Something given from outside cannot be used: a name, a file, a shape, a value.

    The message is one line that says what is wrong, with the value, and what would be right. The command line prints
    it and exits with 2; the page shows it (4xx, JSON). Bytes of a name that is no text show as ``\\udcff``.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message.encode(errors="backslashreplace").decode())


def one_of(kind: str, name: str, available: object) -> BadInput:
    """The error for an unknown name: ``filter 'crosmodal-pf' does not exist. Available: ...``."""
    names = ", ".join(str(a) for a in available)  # type: ignore[attr-defined]
    return BadInput(f"{kind} {name!r} does not exist. Available: {names or 'none'}.")

"""Path checks for files that are addressed by a name from requests."""

from pathlib import Path


def file_within(folder: Path, name: str) -> Path | None:
    """The file at the relative path ``name``, or None if it does not exist or a link or ``..`` leaves the folder."""
    try:
        path = (folder / name).resolve(strict=True)
    except (OSError, ValueError, RuntimeError):  # missing file, null byte, circular links
        return None
    return path if path.is_file() and path.is_relative_to(folder.resolve()) else None

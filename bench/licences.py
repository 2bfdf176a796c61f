"""Licences of all packages of an installation, including extras: a table, and whether each is allowed.

    python bench/licences.py

Exit code 1 if one is not allowed. Only installed packages are checked, not those of other platforms.
"""

from __future__ import annotations

import importlib.metadata
import re
import sys
from collections.abc import Iterator

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

EXTRAS = ("", "attribution", "tensorboard", "ray", "export", "logs")
"""Extras of users but ``video`` (docs/dependencies.md); ``test`` and ``dev`` are for developers."""

ALLOWED = {
    "MIT": r"\bmit\b",
    "BSD": r"\bbsd\b|\b0bsd\b",
    "Apache 2.0": r"\bapache\b",
    "PSF": r"\bpsf\b|python software foundation|python-2\.0|cnri",
    "ISC": r"\bisc\b",
    "MPL 2.0": r"mozilla public license|\bmpl\b",
    "HPND": r"\bhpnd\b|historical permission notice",
    "Unlicense": r"unlicense|public domain",
    "zlib": r"\bzlib\b",
    "Boost": r"\bbsl-1\.0\b",
    "CC0": r"\bcc0\b",
}
"""Licence -> pattern of its names in package metadata. All allow use and redistribution with this project's licence."""

EXCEPTIONS = {
    "uplot-python": "LGPL 3: not imported and not changed; the file served from it, uPlot itself, is MIT",
    "apsw": "any licence that the OSI approves, at the user's choice, so also MIT",
}
"""Package with another licence -> reason for the exception."""


def closure() -> Iterator[str]:
    """Names of the installed direct and indirect requirements."""
    queue, visited = ["beliefscope"], set()
    while queue:
        name = queue.pop()
        if name in visited:
            continue
        visited.add(name)
        try:
            requirements = importlib.metadata.requires(name) or ()
        except importlib.metadata.PackageNotFoundError:
            continue  # belongs to an extra that is not installed
        if name != "beliefscope":
            yield name
        extras = EXTRAS if name == "beliefscope" else ("",)
        for requirement in map(Requirement, requirements):
            if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in extras):
                queue.append(canonicalize_name(requirement.name))


def licence_of(name: str) -> str:
    """Licence of a package according to its metadata, in one line."""
    metadata = importlib.metadata.metadata(name)
    if metadata.get("License-Expression"):
        return metadata["License-Expression"]
    classified = [
        line.rpartition("::")[2].strip() for line in metadata.get_all("Classifier") or () if "License ::" in line
    ]
    if classified:
        return ", ".join(classified)
    return (metadata.get("License") or "").strip().partition("\n")[0]


def is_allowed(licence: str) -> bool:
    """Whether a licence expression is allowed: one of ``A OR B``, all of ``A AND B``."""
    parts = re.split(r"\bAND\b|,", licence)
    return all(any(re.search(words, part, re.IGNORECASE) for words in ALLOWED.values()) for part in parts)


def main() -> int:
    violations = 0
    for name in sorted(closure()):
        licence = licence_of(name)
        accepted = is_allowed(licence) or name in EXCEPTIONS
        violations += not accepted
        note = EXCEPTIONS.get(name, "" if accepted else "<- not allowed")
        print(f"{name:<28}{importlib.metadata.version(name):<14}{licence}  {note}".rstrip())
    print(f"\n{violations} not allowed" if violations else "\nAll are allowed.")
    return int(violations > 0)


if __name__ == "__main__":
    sys.exit(main())

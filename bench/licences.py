"""Licences of all that an installation brings, the extras included: a table, and whether each is among those allowed.

    python bench/licences.py

Ends with 1 where one is not. What is installed is asked, so that what only other platforms need is left out.
"""

from __future__ import annotations

import importlib.metadata
import re
import sys
from collections.abc import Iterator

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

EXTRAS = ("", "ray", "export", "meshes")
"""Of our own; ``dev`` stays on the machines of those who work on the project."""

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
"""Licence -> how packages' metadata write it. Whoever has the code may use it and pass it on, and ours stays ours."""

EXCEPTIONS = {"uplot-python": "LGPL 3: not imported and not changed; what is served out of it, uPlot itself, is MIT"}
"""Package that is none of these -> why it may be here all the same."""


def closure() -> Iterator[str]:
    """Names of the installed packages that ours needs, directly or not."""
    waiting, seen = ["beliefscope"], set()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        try:
            wanted = importlib.metadata.requires(name) or ()
        except importlib.metadata.PackageNotFoundError:
            continue  # of an extra that is not installed
        if name != "beliefscope":
            yield name
        extras = EXTRAS if name == "beliefscope" else ("",)
        for one in map(Requirement, wanted):
            if one.marker is None or any(one.marker.evaluate({"extra": extra}) for extra in extras):
                waiting.append(canonicalize_name(one.name))


def said(name: str) -> str:
    """What a package's metadata say its licence is, in a line."""
    metadata = importlib.metadata.metadata(name)
    if metadata.get("License-Expression"):
        return metadata["License-Expression"]
    classified = [
        one.rpartition("::")[2].strip() for one in metadata.get_all("Classifier") or () if "License ::" in one
    ]
    if classified:
        return ", ".join(classified)
    return (metadata.get("License") or "").strip().partition("\n")[0]


def allowed(licence: str) -> bool:
    """Of ``A OR B`` one is enough, of ``A AND B`` all are needed."""
    parts = re.split(r"\bAND\b|,", licence)
    return all(any(re.search(words, part, re.IGNORECASE) for words in ALLOWED.values()) for part in parts)


def main() -> int:
    refused = 0
    for name in sorted(closure()):
        licence = said(name)
        fits = allowed(licence) or name in EXCEPTIONS
        refused += not fits
        note = EXCEPTIONS.get(name, "" if fits else "<- not allowed")
        print(f"{name:<28}{importlib.metadata.version(name):<14}{licence}  {note}".rstrip())
    print(f"\n{refused} not allowed" if refused else "\nAll are allowed.")
    return int(refused > 0)


if __name__ == "__main__":
    sys.exit(main())

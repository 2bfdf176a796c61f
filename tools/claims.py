"""Compares measured numbers in README.md and docs/ with the output of the commands that print them.

    python tools/claims.py              quick commands
    python tools/claims.py --all        long commands as well
    python tools/claims.py docs/data.md claims of these files only

An HTML comment behind the numbers names their command, and where its output has them:

    evaluated on 64 episodes<!-- claim: beliefscope evaluate door --filter image-ekf --json - => $.episodes -->
    errors of 1.9 and 3.5 cm<!-- claim: python bench/x.py => x: ([\\d.]+), y: ([\\d.]+) ± 0.2 -->

After ``=>`` are paths into a JSON document, separated by commas, each with an optional factor
(``$.rmse.angle * 100``), or a regular expression with a group for each number. As many numbers are taken from the text
in front of the comment. They may differ by half a unit of their last digit, or by the value after ``±``. Commands
joined by ``&&`` run in a temporary folder that has links to the folders of the project. ``claim long:`` marks commands
of more than 20 s of CPU time. ``measured:`` names the command of times and of other values that depend on the machine,
which are never compared.

Exit code 1: a number differs, or a command fails.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent

MARKER = re.compile(r"<!--\s*(claim|claim long|measured):\s*(.+?)\s*-->", re.DOTALL)
CLAIM = re.compile(r"(?P<command>.+?)\s+=>\s+(?P<pattern>.+?)(?:\s+±\s*(?P<tolerance>[\d.e-]+))?", re.DOTALL)
NUMBER = re.compile(r"(?<![\w.])[-−+]?\d(?:[\d,]*\d)?(?:\.\d+)?(?:e[-+]?\d+)?")  # noqa: RUF001 (minus sign)
PATH = re.compile(r"\$\.(?P<keys>\S+)(?:\s+\*\s+(?P<factor>[\d.e-]+))?")


class ClaimError(Exception):
    """A marker that cannot be read, or a command without the expected output."""


@dataclass(frozen=True)
class Claim:
    """Numbers of one comment. place: file:line. documented: as in the text. tolerance: None for the last digit."""

    place: str
    long: bool
    command: str
    pattern: str
    documented: tuple[str, ...]
    tolerance: float | None

    def compare(self, output: str) -> list[tuple[str, float, bool]]:
        """(documented, measured, whether they agree) of each number. Raises ClaimError."""
        measured = extract(self.pattern, output)
        return [
            (text, value, abs(number(text) - value) <= self.limit(text))
            for text, value in zip(self.documented, measured, strict=True)
        ]

    def limit(self, text: str) -> float:
        """Largest difference from the documented number; half a unit of its last digit includes the rounding."""
        if self.tolerance is not None:
            return self.tolerance * (1 + 1e-9)
        digits, _, exponent = text.lower().partition("e")
        places = len(digits.partition(".")[2])
        return 0.5000001 * 10.0 ** (int(exponent or 0) - places)


def number(text: str) -> float:
    return float(text.replace(",", "").replace("−", "-"))  # noqa: RUF001


def read(path: Path) -> list[Claim]:
    """All claims of a Markdown file. Raises ClaimError."""
    claims, text = [], path.read_text(encoding="utf-8")
    for match in MARKER.finditer(text):
        if match[1] == "measured":
            continue
        place = f"{path.name}:{text.count(chr(10), 0, match.start()) + 1}"
        parts = CLAIM.fullmatch(match[2])
        if parts is None:
            raise ClaimError(f"{place}: not of the form 'claim: COMMAND => PATTERN': {match[0]}")
        pattern, tolerance = " ".join(parts["pattern"].split()), parts["tolerance"]
        before = NUMBER.findall(MARKER.sub(" ", text[: match.start()]))
        count = len(paths(pattern)) or re.compile(pattern).groups
        if not 0 < count <= len(before):
            raise ClaimError(f"{place}: {count} values in the pattern, {len(before)} numbers in front of it")
        command = " ".join(parts["command"].split())
        documented = tuple(before[-count:])
        limit = None if tolerance is None else float(tolerance)
        claims.append(Claim(place, match[1] == "claim long", command, pattern, documented, limit))
    return claims


def paths(pattern: str) -> list[re.Match[str]]:
    """The JSON paths of a pattern; none for a regular expression."""
    if not pattern.startswith("$."):
        return []
    matches = [PATH.fullmatch(part.strip()) for part in pattern.split(",")]
    if None in matches:
        raise ClaimError(f"not JSON paths: {pattern}")
    return [match for match in matches if match is not None]


def extract(pattern: str, output: str) -> list[float]:
    """The numbers of a command's output that a pattern selects. Raises ClaimError."""
    if selected := paths(pattern):
        document = json.loads(output)
        return [float(follow(document, m["keys"])) * float(m["factor"] or 1) for m in selected]
    match = re.search(pattern, output)
    if match is None:
        raise ClaimError(f"no match for {pattern!r} in {output[-300:]!r}")
    return [number(group) for group in match.groups()]


def follow(document: Any, keys: str) -> Any:
    """The value at ``a.0.b`` of a JSON document; keys with dots are matched as far as they exist."""
    rest = keys
    while rest:
        if isinstance(document, list):
            key, _, rest = rest.partition(".")
            document = document[int(key)]
            continue
        names = [name for name in document if rest == name or rest.startswith(f"{name}.")]
        if not names:
            raise ClaimError(f"no {rest!r} in {list(document)}")
        name = max(names, key=len)
        document, rest = document[name], rest[len(name) + 1 :]
    return document


def execute(command: str) -> str:
    """Standard output of a command, in a temporary folder with links to the project's folders. Raises ClaimError."""
    with tempfile.TemporaryDirectory() as folder:
        for part in ROOT.iterdir():
            if part.is_dir() and not part.name.startswith("."):
                os.symlink(part, Path(folder, part.name))
        output = ""
        for line in command.split(" && "):
            arguments = shlex.split(line)
            programs = {"beliefscope": ["-m", "beliefscope"], "python": []}
            if arguments[0] in programs:
                arguments = [sys.executable, *programs[arguments[0]], *arguments[1:]]
            result = subprocess.run(arguments, cwd=folder, capture_output=True, text=True, check=False)
            if result.returncode:
                raise ClaimError(f"exit code {result.returncode}: {result.stderr.strip()[-300:]}")
            output = result.stdout
    return output


def main(arguments: Iterable[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="Markdown files; default: README.md and docs/*.md")
    parser.add_argument("--all", action="store_true", help="run long commands as well")
    options = parser.parse_args(None if arguments is None else list(arguments))
    files = options.files or [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    try:
        claims = [claim for path in files for claim in read(path)]
    except ClaimError as error:
        print(error, file=sys.stderr)
        return 1
    selected = [claim for claim in claims if options.all or not claim.long]
    failures = 0
    for command in dict.fromkeys(claim.command for claim in selected):
        began = time.monotonic()
        try:
            output, error = execute(command), ""
        except ClaimError as failure:
            output, error = "", str(failure)
        print(f"{command}  ({time.monotonic() - began:.0f} s)", flush=True)
        for claim in (claim for claim in selected if claim.command == command):
            failures += report(claim, output, error)
    numbers = sum(len(claim.documented) for claim in selected)
    skipped = len(claims) - len(selected)
    print(f"{numbers} numbers, {failures} differ" + (f"; {skipped} long claims skipped (--all)" if skipped else ""))
    return 1 if failures else 0


def report(claim: Claim, output: str, error: str) -> int:
    """Prints a line for each number; how many differ."""
    try:
        if error:
            raise ClaimError(error)
        rows = claim.compare(output)
    except (ClaimError, ValueError, KeyError, IndexError, TypeError) as failure:
        print(f"  {claim.place:<24} {', '.join(claim.documented)}: failed: {failure}")
        return len(claim.documented)
    for documented, measured, agrees in rows:
        print(f"  {claim.place:<24} {documented:>10} {measured:>12.6g}  {'ok' if agrees else 'differs'}")
    return sum(not agrees for _, _, agrees in rows)


if __name__ == "__main__":
    sys.exit(main())

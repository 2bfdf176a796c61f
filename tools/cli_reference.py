"""Writes docs/cli.md, the reference of the command line, from the commands themselves.

python tools/cli_reference.py
"""

from __future__ import annotations

import inspect
import re
from collections import Counter
from pathlib import Path

from beliefscope.app.cli.main import COMMANDS, GROUPS, command_group

FILE = Path(__file__).resolve().parent.parent / "docs" / "cli.md"

INTRODUCTION = """# Command line

The commands of `beliefscope`, from their help texts<!-- generated: python tools/cli_reference.py -->. Exit codes:
0 success, 1 failure, 2 invalid input. `--debug` before the command prints a traceback on errors. The *paper* is
[Lee et al., 2020](filters.md).
"""

SHARED = 4
"""Number of commands from which an argument with the same description is in the table of shared arguments."""

Row = tuple[str, str]
"""An argument or option with its values, and its description."""


def reference() -> str:
    """The page: the shared arguments; for each command its description, own arguments, options and examples."""
    group = command_group()
    context = group.make_context("beliefscope", ["--version"], resilient_parsing=True)
    texts: dict[str, str] = {}
    rows: dict[str, list[Row]] = {}
    for name in COMMANDS:
        command = group.get_command(context, name)
        inner = command.make_context(name, [], parent=context, resilient_parsing=True)
        usage = " ".join(command.collect_usage_pieces(inner))
        texts[name] = f"## {name}\n\n```\nUsage: beliefscope {name} {usage}\n```\n\n{described(command.help or '')}\n"
        records = (parameter.get_help_record(inner) for parameter in command.get_params(inner))
        rows[name] = [record for record in records if record and "--help" not in record[0]]
    numbers = Counter(row for own in rows.values() for row in own)
    shared = [row for row, number in numbers.most_common() if number >= SHARED]
    shared.sort(key=lambda row: row[0].startswith("-"))  # arguments before options
    groups = (f"- {title}: {', '.join(f'[{name}](#{name})' for name in names)}" for title, names in GROUPS.items())
    parts = [INTRODUCTION, "\n".join(groups) + "\n"]
    parts.append(
        "## Shared arguments\n\nEach command lists its own arguments, then the names of shared ones.\n\n"
        + table(shared)
    )
    for name, text in texts.items():
        parts.append(text)
        if own := [row for row in rows[name] if row not in shared]:
            parts.append(table(own))
        if common := [code(row[0].split(" ")[0]) for row in rows[name] if row in shared]:
            parts.append(f"[Shared](#shared-arguments): {', '.join(common)}.\n")
    return "\n".join(parts)


def table(rows: list[Row]) -> str:
    lines = "\n".join(f"| {code(left)} | {cell(right)} |" for left, right in rows)
    return f"| argument | meaning |\n| --- | --- |\n{lines}\n"


def described(text: str) -> str:
    """A help text as Markdown: preformatted paragraphs are code."""
    paragraphs = []
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        if not paragraph.startswith("\b"):
            paragraphs.append(escaped(" ".join(paragraph.split())))
            continue
        title, *lines = paragraph.removeprefix("\b\n").splitlines()
        paragraphs.append(title + "\n\n```sh\n" + inspect.cleandoc("\n".join(lines)) + "\n```")
    return "\n\n".join(paragraphs)


def code(text: str) -> str:
    return "`" + " ".join(text.split()).replace("|", "\\|") + "`"


def cell(text: str) -> str:
    return escaped(" ".join(text.split())).replace("|", "\\|")


def escaped(text: str) -> str:
    """Text in which no character is markup."""
    return re.sub(r"([*_<\[`])", r"\\\1", text)


if __name__ == "__main__":
    FILE.write_text(reference())

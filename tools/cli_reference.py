"""Writes docs/cli.md, the reference of the command line, from the commands themselves.

python tools/cli_reference.py
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from beliefscope.app.cli.main import COMMANDS, command_group

FILE = Path(__file__).resolve().parent.parent / "docs" / "cli.md"

INTRODUCTION = """# Command line

The commands of `beliefscope`, from their help texts<!-- generated: python tools/cli_reference.py -->. Exit codes:
0 success, 1 failure, 2 invalid input. `--debug` before the command prints a traceback on errors.
"""


def reference() -> str:
    """The page: for each command its description, arguments, options and examples."""
    group = command_group()
    context = group.make_context("beliefscope", ["--version"], resilient_parsing=True)
    parts = [INTRODUCTION, ", ".join(f"[{name}](#{name})" for name in COMMANDS) + "\n"]
    for name in COMMANDS:
        command = group.get_command(context, name)
        inner = command.make_context(name, [], parent=context, resilient_parsing=True)
        usage = " ".join(command.collect_usage_pieces(inner))
        parts.append(f"## {name}\n\n```\nUsage: beliefscope {name} {usage}\n```\n\n{described(command.help or '')}\n")
        rows = [row for p in command.get_params(inner) if (row := p.get_help_record(inner)) and "--help" not in row[0]]
        if rows:
            table = "\n".join(f"| {code(left)} | {cell(right)} |" for left, right in rows)
            parts.append(f"| argument | meaning |\n| --- | --- |\n{table}\n")
    return "\n".join(parts)


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

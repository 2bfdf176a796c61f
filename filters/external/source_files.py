"""Source files of functions and classes, with their imports."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib.util import resolve_name
from pathlib import Path
from types import ModuleType
from typing import Any

PACKAGE = "beliefscope"

INSTALLED = {"site-packages", "dist-packages"}
"""Folders of installed packages."""


def file_of(part: Any) -> str | None:
    """File of the module of a function or class; None in a notebook."""
    return getattr(sys.modules.get(part.__module__), "__file__", None)


def is_own(part: Any) -> bool:
    """Whether a function or class is the user's: not of Python, an installed package or this package."""
    module = part.__module__
    return isinstance(module, str) and _is_own(module, file_of(part))


def files_with_imports(parts: Iterable[Any]) -> set[Path]:
    """Files of functions and classes; of the user's code, also the files of all imports."""
    files: set[Path] = set()
    pending = [(sys.modules[part.__module__], is_own(part)) for part in parts if file_of(part) is not None]
    while pending:
        module, own = pending.pop()
        file = Path(module.__file__ or "")
        if file not in files:
            files.add(file)
            for other in _imports(module, file) if own else ():
                if getattr(other, "__file__", None) is not None and _is_own(other.__name__, other.__file__):
                    pending.append((other, True))
    return files


def _is_own(module: str, file: str | None) -> bool:
    is_known = module.partition(".")[0] in {PACKAGE, *sys.stdlib_module_names}
    return not is_known and INSTALLED.isdisjoint(Path(file or "").parts)


def _imports(module: ModuleType, file: Path) -> Iterator[ModuleType]:
    """Imported modules that a file names."""
    names: list[str] = []
    with suppress(OSError, SyntaxError, ValueError):
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                with suppress(ImportError):
                    base = resolve_name("." * node.level + (node.module or ""), module.__package__ or None)
                    names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    yield from filter(None, map(sys.modules.get, names))

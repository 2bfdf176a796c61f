"""Import of user code by name, as in uvicorn: ``FILE.py:NAME`` or ``MODULE:NAME``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import CodeType, ModuleType

from beliefscope.datasets.errors import BadInput

_places: set[str] = set()
_folders: set[Path] = set()
"""Folders of the files that this process has run."""


def has_run() -> bool:
    """Whether this process has loaded user code."""
    return bool(_places)


def load_module(place: str) -> ModuleType:
    """Run a file or import a module. Raises BadInput if it does not exist or fails."""
    if not place.startswith("beliefscope."):  # filters of this package
        _places.add(place)
    return _run_file(Path(place)) if place.endswith(".py") else _import(place)


def functions_of(module: ModuleType) -> list[str]:
    """Names of the functions and classes that a module defines."""
    names = vars(module).items()
    return [name for name, v in names if callable(v) and getattr(v, "__module__", "") == module.__name__]


@contextmanager
def importable(place: str) -> Iterator[None]:
    """Append the folder of the file, or the working directory, to ``sys.path`` temporarily."""
    folder = str(Path(place).resolve().parent if place.endswith(".py") else Path.cwd())
    sys.path.append(folder)
    try:
        yield
    finally:
        sys.path.reverse()
        sys.path.remove(folder)  # the last occurrence
        sys.path.reverse()


def _forget_namesakes(folder: Path) -> None:
    """Lets a file import files next to it whose names are those of files next to another file that has run.

    Without this, two versions of a filter in two folders would share the imports of the first.
    """
    here = {path.stem if path.suffix == ".py" else path.name for path in folder.iterdir()}
    for name, module in list(sys.modules.items()):
        top = name.partition(".")[0]
        if top not in here or (source := getattr(module, "__file__", None)) is None:
            continue
        path = Path(source).resolve()
        homes = [home for home in (folder, *_folders) if path == home / f"{top}.py" or home / top in path.parents]
        if homes and folder not in homes:
            del sys.modules[name]


class _SourceLoader(SourceFileLoader):
    """Ignores stored bytecode: Python compares times in whole seconds, so it would run the file before a quick edit."""

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


def _run_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise BadInput(f"{path} does not exist.")
    folder = path.resolve().parent
    _forget_namesakes(folder)
    _folders.add(folder)
    name = f"beliefscope_user_{path.stem}"
    spec = spec_from_file_location(name, path, loader=_SourceLoader(name, str(path)))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[module.__name__] = module  # required by dataclasses
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[module.__name__]
        raise BadInput(f"{path} cannot be run: {type(error).__name__}: {error}") from error
    return module


def _import(name: str) -> ModuleType:
    try:
        return import_module(name)
    except Exception as error:
        raise BadInput(f"module {name!r} cannot be imported: {type(error).__name__}: {error}") from error

"""The shape of the project: which way imports point, what may be imported where."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("datasets", "filters", "inspect", "recordings", "app")
"""In the order in which they may import: each only from those before it."""

HEAVY = {
    "mujoco": ("datasets",),
    "h5py": ("datasets",),
    "torch": ("filters", "inspect", "recordings", "app"),
    "safetensors": ("filters", "inspect", "recordings", "app"),
    "rerun": ("recordings",),
    "pyarrow": ("recordings",),
    "mcap": ("recordings",),
    "fastapi": ("app",),
    "starlette": ("app",),
    "uvicorn": ("app",),
    "viser": ("app",),
    "mjviser": ("app",),
    "typer": ("app",),
    "rich": ("app",),
    "tensorboardX": ("app",),
    "scipy": ("filters", "inspect"),
    "ray": ("filters",),
    "matplotlib": ("inspect", "recordings"),
    "captum": ("inspect",),
}
"""Distribution's top-level module -> folders that may import it."""

MODULES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
PYTHON_FILES = [*MODULES, *sorted((ROOT / "tests").rglob("*.py")), *sorted((ROOT / "bench").rglob("*.py"))]


def named(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imports(path: Path) -> Iterator[str]:
    """Full names of the imported modules, wherever in the file they are imported."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{named(path)}:{node.lineno}: relative import"
            yield node.module or ""
            # `from beliefscope import app` names the module only in its aliases.
            yield from (f"{node.module}.{alias.name}" for alias in node.names if node.module == "beliefscope")


@pytest.mark.parametrize("folder", [*FOLDERS, "tests"])
def test_given_folders_are_namespace_packages(folder: str) -> None:
    assert (ROOT / folder).is_dir()
    found = [named(path) for path in (ROOT / folder).rglob("__init__.py")]
    assert not found, "with an __init__.py, inspect/ shadows Python's own inspect"


@pytest.mark.parametrize("arguments", [["-c", "{}"], ["-m", "timeit", "-n1", "-r1", "{}"]])
def test_standard_inspect_survives_the_project_root_on_the_path(arguments: list[str]) -> None:
    code = "import inspect, dataclasses; assert inspect.signature and 'site-packages' not in inspect.__file__"
    command = [sys.executable, *(argument.format(code) for argument in arguments)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=60)


def test_pytest_starts_in_the_project_root() -> None:
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "tests/test_structure.py"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("path", MODULES, ids=named)
def test_imports_point_left_and_heavy_ones_stay_in_their_folder(path: Path) -> None:
    folder = path.relative_to(ROOT).parts[0]
    allowed = FOLDERS[: FOLDERS.index(folder) + 1]
    for name in imports(path):
        top, *rest = name.split(".")
        if top == "beliefscope" and rest:
            assert rest[0] in (*allowed, "__version__"), f"{folder} must not import {name}"
        if top in HEAVY:
            assert folder in HEAVY[top], f"{name} is imported in {folder}; it belongs in {', '.join(HEAVY[top])}"


@pytest.mark.parametrize("path", MODULES, ids=named)
def test_nothing_is_unpickled(path: Path) -> None:
    assert not {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve"} & set(imports(path))
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in ("torch.load", "torch.save", "torch.jit.load"), f"line {node.lineno}: {called}"
            for keyword in node.keywords:
                assert keyword.arg != "allow_pickle" or ast.unparse(keyword.value) == "False", f"line {node.lineno}"


@pytest.mark.parametrize("path", PYTHON_FILES, ids=named)
def test_files_stay_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 400, "near 300 lines a file is two files"


@pytest.mark.parametrize("path", MODULES, ids=named)
def test_all_names_what_exists(path: Path) -> None:
    module = importlib.import_module("beliefscope." + named(path).removesuffix(".py").replace("/", "."))
    assert module.__doc__, "a module says what it is for"
    public = getattr(module, "__all__", [])
    assert len(set(public)) == len(public)
    assert not [name for name in public if not hasattr(module, name)]


def tracked_files() -> list[Path]:
    result = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if result.returncode:
        pytest.skip("not a git checkout")
    return [ROOT / name for name in result.stdout.split("\0") if name]


def test_no_path_of_one_machine() -> None:
    """Neither in the files' text nor, for symbolic links, in what they point to."""
    homes = "|".join(("home", "Users", "root", "tmp", "work", "mnt", "opt"))
    absolute = re.compile(rf"(?<![\w.:/)\]}}>*-])/(?:{homes})/[\w.-]+|\b[A-Z]:\\\\?Users\b")
    offences = []
    for path in tracked_files():
        if path.is_symlink():
            assert not path.readlink().is_absolute(), f"{named(path)} points to {path.readlink()}"
        elif path.is_file():
            text = path.read_bytes()
            if b"\0" not in text[:8192]:
                offences += [f"{named(path)}: {m.group()}" for m in absolute.finditer(text.decode())]
    assert not offences

"""Structure of the project. The import layers are checked by import-linter in `make lint` (pyproject.toml)."""

from __future__ import annotations

import ast
import graphlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("datasets", "filters", "inspect", "recordings", "app")
MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 80


def modules(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    nodes = ast.walk(ast.parse(path.read_text()))
    return (node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


@pytest.mark.parametrize("folder", [*FOLDERS, "tests"])
def test_top_folders_are_namespace_packages(folder: str) -> None:
    """With an ``__init__.py``, ``inspect/`` would shadow the standard library's module."""
    assert (ROOT / folder).is_dir()
    assert not (ROOT / folder / "__init__.py").exists()


@pytest.mark.parametrize("arguments", [["-c", "{}"], ["-m", "timeit", "-n1", "-r1", "{}"]])
def test_standard_inspect_is_importable_from_the_project_root(arguments: list[str]) -> None:
    code = "import inspect, dataclasses; assert inspect.signature and 'site-packages' not in inspect.__file__"
    command = [sys.executable, *(argument.format(code) for argument in arguments)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=60)


def test_pytest_starts_in_the_project_root() -> None:
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "tests/test_structure.py"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stdout + result.stderr


def test_no_module_imports_itself_in_a_circle() -> None:
    """Also where an import stands in a function or under TYPE_CHECKING."""
    grimp = pytest.importorskip("grimp", reason="import-linter is not installed (make install)")
    graph = grimp.build_graph(*(f"beliefscope.{folder}" for folder in FOLDERS), cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    graphlib.TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle


def test_no_object_is_unpickled() -> None:
    """import-linter forbids pickle itself; these calls would use it indirectly."""
    offences = []
    for path in modules(*FOLDERS):
        text = path.read_text()
        if not re.search(r"\b(?:load|save|allow_pickle)\b", text):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call):
                unsafe = ast.unparse(node.func) in ("torch.load", "torch.save", "torch.jit.load")
                allowed = [k for k in node.keywords if k.arg == "allow_pickle" and ast.unparse(k.value) != "False"]
                if unsafe or allowed:
                    offences.append(f"{relative(path)}:{node.lineno}: {ast.unparse(node.func)}")
    assert not offences


def test_files_are_short() -> None:
    lengths = {path: len(path.read_text().splitlines()) for path in modules(*FOLDERS, "tests", "bench", "tools")}
    assert not [f"{relative(path)}: {length}" for path, length in lengths.items() if length > MAX_FILE_LINES]


def test_functions_are_short() -> None:
    long = [
        f"{relative(path)}:{node.lineno}: {node.name} has {(node.end_lineno or node.lineno) - node.lineno + 1} lines"
        for path in modules(*FOLDERS)
        for node in functions(path)
        if (node.end_lineno or node.lineno) - node.lineno >= MAX_FUNCTION_LINES
    ]
    assert not long


def tracked_files() -> list[Path]:
    result = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if result.returncode:
        pytest.skip("not a git checkout")
    return [ROOT / name for name in result.stdout.split("\0") if name]


def test_no_absolute_local_path() -> None:
    """Neither in the text of files nor as the target of symbolic links."""
    homes = "|".join(("home", "Users", "root", "tmp", "work", "mnt", "opt"))
    absolute = re.compile(rf"(?<![\w.:/)\]}}>*-])/(?:{homes})/[\w.-]+|\b[A-Z]:\\\\?Users\b")
    offences = []
    for path in tracked_files():
        if path.is_symlink():
            assert not path.readlink().is_absolute(), f"{relative(path)} points to {path.readlink()}"
        elif path.is_file():
            content = path.read_bytes()
            if b"\0" not in content[:8192]:
                offences += [f"{relative(path)}: {m.group()}" for m in absolute.finditer(content.decode())]
    assert not offences

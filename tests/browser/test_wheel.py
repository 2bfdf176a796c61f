"""The wheel: contents, installation in a new environment, and its page in Chromium."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("datasets", "filters", "inspect", "recordings", "app")
PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources, so that setuptools neither writes into the checkout nor reads older builds from it."""
    tree = tmp_path_factory.mktemp("tree")
    for name in ("README_PACKAGE.md", "LICENSE", "pyproject.toml"):
        shutil.copy(ROOT / name, tree)
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in (*FOLDERS, "src"):
        shutil.copytree(ROOT / name, tree / name, symlinks=True, ignore=ignored)
    return tree


@pytest.fixture(scope="module")
def wheel(tree: Path) -> Path:
    command = [*PIP, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", tree / "wheels", tree]
    subprocess.run(command, check=True, timeout=300)
    (wheel,) = (tree / "wheels").glob("beliefscope-*.whl")
    return wheel


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of a new environment with the wheel, which shares the dependencies of this environment."""
    environment = tmp_path_factory.mktemp("environment")
    venv.create(environment, with_pip=False, symlinks=True)
    command = [*PIP, f"--python={environment / 'bin' / 'python'}", "install", "--no-deps", "--no-compile", wheel]
    subprocess.run(command, check=True, timeout=120)
    # .pth files in a folder added by a .pth file are not read, so the editable installation is invisible.
    (site,) = environment.glob("lib/python3*/site-packages")
    (site / "dependencies.pth").write_text(f"{Path(pytest.__file__).parents[1]}\n")
    return environment / "bin" / "beliefscope"


@pytest.fixture
def address(installed: Path, tmp_path: Path) -> Iterator[str]:
    """Address of a server of the installed wheel."""
    command = [installed, "serve", "--port", "0", "--workspace", tmp_path / "workspace"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd="/")
    assert server.stdout is not None
    yield next(word for word in server.stdout.readline().split() if word.startswith("http://"))
    server.terminate()
    assert server.wait(60) == 0


@pytest.mark.long
def test_wheel_contains_all_modules_and_data(wheel: Path, tree: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    data = ("page", "samples", "pretrained")
    sources = [path for folder in FOLDERS for path in (tree / folder).rglob("*") if path.is_file()]
    sources = [path for path in sources if path.suffix == ".py" or path.parent.name in data]
    assert len(sources) > 200
    assert not {f"beliefscope/{path.relative_to(tree).as_posix()}" for path in sources} - names
    assert {"beliefscope/__init__.py", "beliefscope/__main__.py", "beliefscope/py.typed"} <= names
    assert not [name for name in names if "tests/" in name]


@pytest.mark.long
def test_doctor_accepts_the_installation(installed: Path, tmp_path: Path) -> None:
    code = "import beliefscope.app.cli.main as c; print(c.__file__)"
    command = [installed.with_name("python"), "-c", code]
    path = subprocess.run(command, cwd="/", capture_output=True, text=True, check=True, timeout=120).stdout.strip()
    assert Path(path).is_relative_to(installed.parents[1])
    command = [installed, "doctor", "--workspace", tmp_path / "workspace", "--port", "0", "--json", "-"]
    result = subprocess.run(command, cwd="/", capture_output=True, text=True, check=False, timeout=300)
    checks = json.loads(result.stdout)["checks"]
    assert not {name: check for name, check in checks.items() if check["state"] == "failed"}


@pytest.mark.long
def test_page_of_the_installation_shows_maps(address: str, open_page: Any) -> None:
    page = open_page(url=f"{address}?task=door&step=0")
    before = page.maps()
    assert len(before) == 3
    page.page.click("#forward")
    page.settle(1)
    assert page.maps() != before
    page.page.evaluate("document.querySelector('#tab-recordings').click()")
    page.page.locator("#recordings").wait_for()

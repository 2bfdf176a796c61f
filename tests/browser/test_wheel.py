"""The wheel, not the checkout: built, installed into an environment of its own, and its page in a real browser."""

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

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a wheel is made of, apart from the checkout, where setuptools would leave traces and find older ones."""
    tree = tmp_path_factory.mktemp("tree")
    for name in ("README.md", "LICENSE", "pyproject.toml"):
        shutil.copy(ROOT / name, tree)
    made = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in (*FOLDERS, "src"):
        shutil.copytree(ROOT / name, tree / name, symlinks=True, ignore=made)
    return tree


@pytest.fixture(scope="module")
def wheel(tree: Path) -> Path:
    command = [*PIP, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", tree / "wheels", tree]
    subprocess.run(command, check=True, timeout=300)
    (wheel,) = (tree / "wheels").glob("beliefscope-*.whl")
    return wheel


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of an environment that has the wheel, and its dependencies from this environment."""
    environment = tmp_path_factory.mktemp("environment")
    venv.create(environment, with_pip=False, symlinks=True)
    command = [*PIP, f"--python={environment / 'bin' / 'python'}", "install", "--no-deps", "--no-compile", wheel]
    subprocess.run(command, check=True, timeout=120)
    # Without this environment's .pth files: an editable checkout is on the path only through one.
    (site,) = environment.glob("lib/python3*/site-packages")
    (site / "dependencies.pth").write_text(f"{Path(pytest.__file__).parents[1]}\n")
    return environment / "bin" / "beliefscope"


@pytest.fixture
def address(installed: Path, tmp_path: Path) -> Iterator[str]:
    """Of a server of the installed wheel."""
    command = [installed, "serve", "--port", "0", "--workspace", tmp_path / "workspace"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd="/")
    assert server.stdout is not None
    yield next(word for word in server.stdout.readline().split() if word.startswith("http://"))
    server.terminate()
    assert server.wait(60) == 0


def test_it_holds_everything(wheel: Path, tree: Path) -> None:
    inside = set(zipfile.ZipFile(wheel).namelist())
    data = ("page", "samples", "pretrained")
    wanted = [path for folder in FOLDERS for path in (tree / folder).rglob("*") if path.is_file()]
    wanted = [path for path in wanted if path.suffix == ".py" or path.parent.name in data]
    assert len(wanted) > 200
    assert not {f"beliefscope/{path.relative_to(tree).as_posix()}" for path in wanted} - inside
    assert {"beliefscope/__init__.py", "beliefscope/__main__.py", "beliefscope/py.typed"} <= inside
    assert not [name for name in inside if "tests/" in name]


def test_it_is_well_where_it_is_installed(installed: Path, tmp_path: Path) -> None:
    show = "import beliefscope.app.cli.main as c; print(c.__file__)"
    run = [installed.with_name("python"), "-c", show]
    found = subprocess.run(run, cwd="/", capture_output=True, text=True, check=True, timeout=120).stdout.strip()
    assert Path(found).is_relative_to(installed.parents[1])
    run = [installed, "doctor", "--workspace", tmp_path / "workspace", "--port", "0", "--json", "-"]
    examined = subprocess.run(run, cwd="/", capture_output=True, text=True, check=False, timeout=300)
    checks = json.loads(examined.stdout)["checks"]
    assert not {name: one for name, one in checks.items() if one["state"] == "failed"}


def test_its_page_is_drawn(address: str, open_page: Any) -> None:
    page = open_page(url=address)
    before = page.maps()
    assert len(before) == 3
    page.page.click("#forward")
    page.settle(1)
    assert page.maps() != before
    page.page.evaluate("document.querySelector('#tab-recordings').click()")
    page.page.locator("#recordings").wait_for()

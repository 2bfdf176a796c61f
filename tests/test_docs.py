"""Documentation: links resolve, examples run, lists are complete."""

from __future__ import annotations

import re
import tomllib
from html import unescape
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from beliefscope import __version__
from beliefscope.filters.checkpoint import shipped
from beliefscope.inspect.palette import COLOURS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_citation_has_the_version() -> None:
    (version,) = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert version == __version__


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_resolve(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


def test_files_in_the_architecture_exist() -> None:
    paths = re.findall(r"`((?:app|bench|datasets|filters|inspect|recordings|tests|tools)/[\w/.]*)`", architecture())
    assert len(paths) > 10
    assert not [path for path in paths if not (ROOT / path).exists()]


def architecture() -> str:
    return (ROOT / "docs" / "architecture.md").read_text()


def test_every_dependency_is_explained_and_pinned() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    names = {Requirement(text).name for text in requirements} - {"beliefscope"}  # extras include other extras
    rows = re.findall(r"^\| ([a-z][\w, -]*) \|", (ROOT / "docs" / "dependencies.md").read_text(), re.MULTILINE)
    assert names == {name.strip() for row in rows for name in row.split(",")} - {"package"}
    pinned = re.findall(r"^([\w.-]+)==[\w.]+$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert not set(map(canonicalize_name, names)) - set(map(canonicalize_name, pinned))


def test_documented_colours_match_the_palette() -> None:
    table = re.findall(r"^\| (\w+) \| `(#\w{6})` \|$", (ROOT / "docs" / "conventions.md").read_text(), re.MULTILINE)
    assert dict(table) == COLOURS


@pytest.mark.slow
def test_readme_python_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert shipped("door", "crossmodal-pf").is_file()
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), names)
    assert names["error"].shape == (len(names["episode"]), 3)  # type: ignore[attr-defined, arg-type]
    assert "'fused'" in capsys.readouterr().out


def test_key_help_is_complete() -> None:
    page = ROOT / "app" / "page"
    (table,) = re.findall(r"  bindKeys\(\{\n(.*?)\n  \}\);", (page / "core" / "controls.js").read_text(), re.DOTALL)
    keys = {key.strip("'") for key in re.findall(r"^    ('.+?'|\w+):", table, re.MULTILINE)}
    (dialog,) = re.findall(r'<dialog id="keys".*?</dialog>', (page / "index.html").read_text(), re.DOTALL)
    documented = {unescape(key) for key in re.findall(r"<kbd>(.*?)</kbd>", dialog)}
    labels = {
        " ": "space",
        "ArrowLeft": "←",
        "ArrowRight": "→",
        "PageUp": "page ↑",
        "PageDown": "page ↓",
        "-": "\N{MINUS SIGN}",
    }
    labels |= {
        "Home": "home",
        "End": "end",
        "=": "+",
        "ctrl+k": "ctrl k",
        "ctrl+z": "ctrl z",
        "ctrl+y": "ctrl z",
        "ctrl+shift+z": "shift",
    }
    assert {labels.get(key, key) for key in keys} | {"shift"} == documented

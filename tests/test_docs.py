"""The documentation says what is so: links lead somewhere, examples run, lists are complete."""

from __future__ import annotations

import re
import tomllib
from html import unescape
from pathlib import Path

import pytest

from beliefscope.filters.checkpoint import shipped
from beliefscope.inspect.palette import COLOURS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


def test_files_named_in_the_architecture_exist() -> None:
    named = re.findall(r"`((?:app|bench|datasets|filters|inspect|recordings|tests)/[\w/.]*)`", architecture())
    assert len(named) > 10
    assert not [path for path in named if not (ROOT / path).exists()]


def architecture() -> str:
    return (ROOT / "docs" / "architecture.md").read_text()


def test_every_dependency_is_explained_and_pinned() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(name for extra in project["optional-dependencies"].values() for name in extra),
    ]
    names = {re.split(r"[<>=!~\[; ]", requirement)[0] for requirement in wanted} - {"beliefscope"}
    rows = re.findall(r"^\| ([a-z][\w, -]*) \|", (ROOT / "docs" / "dependencies.md").read_text(), re.MULTILINE)
    assert names == {name.strip() for row in rows for name in row.split(",")} - {"package"}
    pinned = re.findall(r"^([\w.-]+)==[\w.]+$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert not {name.lower() for name in names} - {name.lower() for name in pinned}


def test_colours_are_the_palette() -> None:
    table = re.findall(r"^\| (\w+) \| `(#\w{6})` \|$", (ROOT / "docs" / "conventions.md").read_text(), re.MULTILINE)
    assert dict(table) == COLOURS


def test_readme_python_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert shipped("door", "crossmodal-pf").is_file()
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), names)
    assert names["error"].shape == (len(names["episode"]), 3)  # type: ignore[attr-defined, arg-type]
    assert "'fused'" in capsys.readouterr().out


def test_the_sheet_of_keys_has_every_key() -> None:
    page = ROOT / "app" / "page"
    (table,) = re.findall(r"  bindKeys\(\{\n(.*?)\n  \}\);", (page / "core" / "controls.js").read_text(), re.DOTALL)
    does = {key.strip("'") for key in re.findall(r"^    ('.+?'|\w+):", table, re.MULTILINE)}
    (sheet,) = re.findall(r'<dialog id="keys".*?</dialog>', (page / "index.html").read_text(), re.DOTALL)
    said = {unescape(key) for key in re.findall(r"<kbd>(.*?)</kbd>", sheet)}
    called = {
        " ": "space",
        "ArrowLeft": "←",
        "ArrowRight": "→",
        "PageUp": "page ↑",
        "PageDown": "page ↓",
        "-": "\N{MINUS SIGN}",
    }
    called |= {"Home": "home", "End": "end", "=": "+", "ctrl+z": "ctrl z", "ctrl+y": "ctrl z", "ctrl+shift+z": "shift"}
    assert {called.get(key, key) for key in does} | {"shift"} == said

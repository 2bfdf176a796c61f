"""Documentation: links resolve, examples run, lists are complete."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
import tomllib
from html import unescape
from importlib import import_module
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import beliefscope as bs
from beliefscope import __version__
from beliefscope.filters.checkpoint import PRETRAINED, pretrained_path
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.palette import COLOURS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "README_PACKAGE.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]


def test_citation_has_the_version() -> None:
    (version,) = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert version == __version__


def test_package_description_links_to_no_file() -> None:
    """A package index shows it without the repository."""
    text = (ROOT / "README_PACKAGE.md").read_text()
    assert not re.findall(r"\]\((?!https://)", text)
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["readme"] == "README_PACKAGE.md"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_resolve(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", page.read_text())
    for target, anchor in (
        (page if not path else page.parent / path, anchor) for path, anchor in links if "://" not in path
    ):
        assert target.exists(), target
        assert not anchor or anchor in anchors(target), f"{target}#{anchor}"


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page, as repository hosts and the documentation site name them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_front_page_answers_twelve_questions() -> None:
    """Each question links to its answer: a heading, or the start of a page."""
    questions = re.findall(r"^\d+\. \[(.+\?)\]\((.+?)\)$", (ROOT / "docs" / "index.md").read_text(), re.MULTILINE)
    assert len(questions) == 12
    assert len({link for _, link in questions}) == 12


def test_site_has_every_page() -> None:
    listed = re.findall(r"([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    pages = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert sorted(listed) == sorted(pages | {"changelog.md"})


def test_every_diagnostic_has_limits_and_a_remedy() -> None:
    text = (ROOT / "docs" / "diagnostics.md").read_text()
    sections = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL))
    for entry in DIAGNOSTICS.values():
        section = sections[entry.title]
        assert re.match(r"\*[^*]+\?\*", section), entry.title
        assert re.search(r"`[^`]*[=/(∫√Σ][^`]*`", section), f"{entry.title} has no equation"
        assert section.index("**How it can mislead.**") < section.index("**What to do.**")


def test_false_alarms_of_every_trained_filter_are_documented() -> None:
    text = (ROOT / "docs" / "diagnostics.md").read_text()
    table = text.split("| filter | false alarms |")[1].split("\n\n")[0]
    rates = dict(re.findall(r"^\| ([\w-]+) \| ([\d.]+) % \|", table, re.MULTILINE))
    assert sorted(rates) == sorted(path.stem for path in PRETRAINED.glob("*.safetensors"))
    assert max(map(float, rates.values())) <= 5.0, "no alarm in 95 % of the samples"


def test_python_reference_is_complete() -> None:
    text = (ROOT / "docs" / "python_reference.md").read_text()
    names = re.findall(r"^::: (\S+)\.(\w+)$", text, re.MULTILINE)
    assert {name for _, name in names} == set(bs.__all__) - {"__version__"}
    for module, name in names:
        assert getattr(import_module(module), name) is getattr(bs, name)


def test_command_line_reference_is_current() -> None:
    tool = runpy.run_path(str(ROOT / "tools" / "cli_reference.py"))
    assert (ROOT / "docs" / "cli.md").read_text() == tool["reference"](), "run python tools/cli_reference.py"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The documentation site, built without warnings."""
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


@pytest.mark.long
def test_site_loads_nothing_from_other_hosts(site: Path) -> None:
    pages = [page.read_text() for page in site.rglob("*.html")]
    assert len(pages) > 30
    assert not [
        p for page in pages for p in re.findall(r'<(?:script|img|link rel="stylesheet")[^>]+"https?://[^"]+"', page)
    ]


@pytest.mark.long
@pytest.mark.browser
def test_site_is_searched_from_the_disk(site: Path, chromium: str) -> None:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_context(offline=True).new_page()
        page.goto((site / "tutorials" / "inspect_a_run.html").as_uri())
        page.keyboard.press("s")
        page.keyboard.type("Shapley")
        result = page.locator(".md-search-result__link").first
        result.wait_for(timeout=30_000)
        assert "diagnostics.html" in str(result.get_attribute("href"))
        browser.close()


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
    assert pretrained_path("door", "crossmodal-pf").is_file()
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), names)
    assert names["error"].shape == (len(names["episode"]), 3)  # type: ignore[attr-defined, arg-type]
    assert "'fused'" in capsys.readouterr().out


@pytest.mark.slow
def test_python_of_the_diagnostics_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "docs" / "diagnostics.md").read_text()
    monkeypatch.chdir(tmp_path)
    checkpoint = bs.load_filter("push/crossmodal-ekf")
    run, other = (bs.trace(checkpoint, "push", 9, faults=faults) for faults in ("", "blackout"))
    bs.save_trace(run, Path("run.trace"))
    names: dict[str, object] = {"checkpoint": checkpoint, "run": run, "other": other}
    for example in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(example, "diagnostics.md", "exec"), names)
    assert "(32, 32)" in capsys.readouterr().out


@pytest.mark.slow
def test_python_of_external_filters_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    examples = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "own_filter.md").read_text(), re.DOTALL)
    monkeypatch.chdir(ROOT)
    names: dict[str, object] = {}
    for example in examples:
        exec(compile(example, "own_filter.md", "exec"), names)

    (tmp_path / "mine.py").write_text(examples[0])
    metrics = bs.evaluate(f"{tmp_path / 'mine.py'}:Mine", "door", [9])
    assert metrics.rmse["position_cm"] == 0.0  # as stated, it keeps its start


def test_key_help_is_complete() -> None:
    page = ROOT / "app" / "page"
    (table,) = re.findall(r"  bindKeys\(\{\n(.*?)\n  \}\);", (page / "core" / "controls.js").read_text(), re.DOTALL)
    keys = {key.strip("'") for key in re.findall(r"^    ('.+?'|\w+):", table, re.MULTILINE)}
    html = (page / "index.html").read_text()
    keys |= set(re.findall(r'role="tab".*? aria-keyshortcuts="(.+?)"', html))
    (dialog,) = re.findall(r'<dialog id="keys".*?</dialog>', html, re.DOTALL)
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

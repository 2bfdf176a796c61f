"""Hooks of the documentation site (mkdocs.yml): files of the project that pages link to become part of the site.

A page of docs/ may link to any file of the project, so that the links work on a repository host. The site contains
these files under ``project/``, the changelog as a page, and the tutorials as notebooks.
"""

from __future__ import annotations

import json
import posixpath
import re
import runpy
import shutil
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"(\]\()([^)\s#]+)([^)]*\))")
PAGES = {"CHANGELOG.md": "changelog.md"}
"""File of the project -> page of the site."""


def on_startup(**_: Any) -> None:
    """Copy the package with ``__init__.py`` in every folder, without which docstrings are not collected.

    Before the configuration: its paths must exist.
    """
    copy = ROOT / "build" / "source"
    shutil.rmtree(copy, ignore_errors=True)

    def other_files(folder: str, names: list[str]) -> list[str]:
        return [name for name in names if not name.endswith(".py") and not Path(folder, name).is_dir()]

    shutil.copytree(ROOT / "src", copy, ignore=other_files)
    for folder in filter(Path.is_dir, [*(copy / "beliefscope").rglob("*")]):
        (folder / "__init__.py").touch()


def on_files(files: Any, config: Any) -> Any:
    """Add the linked files outside of docs/, the changelog and the notebooks."""
    from mkdocs.structure.files import File

    for name, page in PAGES.items():
        text = (ROOT / name).read_text().replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    for page in [*files.documentation_pages()]:
        for _, link, _ in LINK.findall(page.content_string):
            target = outside(page.src_uri, link)
            if target and target not in PAGES and not files.get_file_from_path(f"project/{target}.txt"):
                copy = File.generated(config, f"project/{target}.txt", content=(ROOT / target).read_text())
                files.append(copy)
    tool = runpy.run_path(str(ROOT / "tools" / "tutorials.py"))
    for path in sorted((ROOT / "docs" / "tutorials").glob("*.md")):
        notebook = json.dumps(tool["Tutorial"].read(path).notebook(), indent=1)
        files.append(File.generated(config, f"tutorials/{path.stem}.ipynb", content=notebook))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Turn links to files of the project into links to their copies; offer tutorials as notebooks."""
    here = page.file.src_uri

    def replaced(match: re.Match[str]) -> str:
        target = outside(here, match[2])
        if not target:
            return match[0]
        copy = PAGES.get(target, f"project/{target}.txt")
        rest = match[3] if target in PAGES else ")"
        return match[1] + posixpath.relpath(copy, posixpath.dirname(here) or ".") + rest

    if here.startswith("tutorials/"):
        title, _, rest = markdown.partition("\n")
        markdown = f"{title}\n\n[Notebook]({Path(here).stem}.ipynb)\n{rest}"
    return LINK.sub(replaced, markdown)


def outside(page: str, link: str) -> str:
    """Path in the project of a file outside of docs/ that a page links to; empty for other links."""
    if "://" in link:
        return ""
    folder = "." if page == "changelog.md" else posixpath.join("docs", posixpath.dirname(page))
    target = posixpath.normpath(posixpath.join(folder, link))
    return "" if target.startswith(("docs/", "..")) or not (ROOT / target).is_file() else target

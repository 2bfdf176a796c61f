"""Screenshots of every view of the page in several sizes, light and dark, with long file names.

python bench/screens.py FOLDER
python bench/screens.py FOLDER --view study --view keys --size 1024x768 --theme dark
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright
from served import serving

from beliefscope.datasets.store import sample_path
from beliefscope.filters.checkpoint import shipped

SIZES = ("900x700", "1024x768", "1280x720", "1440x900", "1920x1080", "3840x2160")
THEMES = ("light", "dark")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
LONG = "a-filter-trained-on-the-third-floor-with-the-new-camera-v12b"
TIMEOUT = 120_000  # ms
SETTLE = 1200  # ms for animations to end

LINKS = {"first": "", "bad-link": "?task=door&episode=4711&faults=blakout%3D0.4&filter=crossmodal-fp"}
"""View -> address that opens it: the first visit, and a selection that does not exist."""


def tab(name: str, ready: str = "true", press: str = "") -> Callable[[Page], None]:
    """Return a function that opens a tab, presses the named button if visible, and waits."""

    def show(page: Page) -> None:
        page.evaluate(f"document.querySelector('#tab-{name}').click()")
        page.wait_for_timeout(SETTLE)
        button = page.locator(f"#{name}").get_by_role("button", name=press, exact=True)
        if press and button.count() and button.first.is_visible():
            button.first.click()
        page.wait_for_function(f"() => {ready}", timeout=TIMEOUT)

    return show


def click(selector: str) -> Callable[[Page], None]:
    return lambda page: page.evaluate(f"document.querySelector({selector!r}).click()")


def state(panel: str) -> str:
    return f"document.querySelector('{panel}').dataset.state === 'ready'"


VIEWS: dict[str, Callable[[Page], None]] = {
    "diagnosis": tab("diagnosis", "diagnosis.dataset.state === 'ready'"),
    "failures": tab("failures", state("#failures"), "Search for failures"),
    "compare": tab("compare", state("#compare .result"), "Compare"),
    "study": tab("study", state("#study")),
    "rerun": tab("rerun", "['ready', 'error'].includes(document.querySelector('#rerun').dataset.state)"),
    "layers": tab("scene", state("#scene"), "Layers…"),
    "maps-options": click("#maps-view"),
    "report": click("#report"),
    "keys": click("#help"),
    "jobs": click("#jobs-button"),
    "commands": click("#find"),
    "maps-several": click("#maps-tiles input[value=several]"),
}
"""View -> function that opens it; every tab is a view as well."""


def close(page: Page) -> None:
    """Close dialogs and popovers."""
    page.evaluate(
        "() => { document.querySelector('dialog[open]')?.close();"
        " document.querySelector('[popover]:popover-open')?.hidePopover();"
        " if (!document.querySelector('#jobs').hidden) document.querySelector('#jobs-button').click(); }"
    )


def shoot(browser: Any, url: str, folder: Path, size: str, theme: str, views: list[str]) -> None:
    width, height = map(int, size.split("x"))
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=theme)
    page.goto(f"{url}?task=door&step=40", timeout=TIMEOUT)
    page.wait_for_function("() => window.beliefscope?.stats.maps?.size === 135", timeout=TIMEOUT)
    tabs = [
        name.removeprefix("tab-") for name in page.eval_on_selector_all("[role=tab]", "all => all.map((t) => t.id)")
    ]
    for name in [*tabs, *(name for name in VIEWS if name not in tabs)]:
        if views and name not in views:
            continue
        VIEWS.get(name, tab(name))(page)
        page.wait_for_timeout(SETTLE)
        page.screenshot(path=folder / f"{name}-{size}-{theme}.png", timeout=TIMEOUT)
        close(page)
    for name, link in LINKS.items():
        if not views or name in views:
            page.goto(url + link, timeout=TIMEOUT)
            page.wait_for_function("() => window.beliefscope?.stats.maps?.size === 135", timeout=TIMEOUT)
            page.wait_for_timeout(2 * SETTLE)
            page.screenshot(path=folder / f"{name}-{size}-{theme}.png", timeout=TIMEOUT)
    page.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--view", action="append", default=[], help="a tab or one of " + ", ".join([*VIEWS, *LINKS]))
    parser.add_argument("--size", action="append", choices=SIZES)
    parser.add_argument("--theme", action="append", choices=THEMES)
    parser.add_argument("--url", help="of a running server")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as files, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)

        def shoot_all(url: str) -> None:
            for size in args.size or SIZES:
                for theme in args.theme or THEMES:
                    shoot(browser, url, args.folder, size, theme, args.view)

        if args.url:
            shoot_all(args.url)
            return
        filter_ = shutil.copy(shipped("door", "crossmodal-pf"), Path(files) / f"{LONG}.safetensors")
        data = shutil.copy(sample_path("door"), Path(files) / f"{LONG.replace('filter', 'set-of-doors')}.h5")
        with serving("--filter", str(filter_), "--data", str(data)) as server:
            shoot_all(server.url)


if __name__ == "__main__":
    main()

"""Screenshots of every view of the page in several sizes, light and dark, with long file names.

python bench/screens.py FOLDER
python bench/screens.py FOLDER --view study --view keys --size 1024x768 --theme dark
python bench/screens.py FOLDER --read-only
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import sensor_rigs
from playwright.sync_api import Page, sync_playwright
from server_process import serving

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import pretrained_path
from beliefscope.inspect.sweep import Inputs
from beliefscope.recordings.sweep_table import run_sweep

SIZES = ("900x700", "1024x768", "1280x720", "1440x900", "1920x1080", "3840x2160")
THEMES = ("light", "dark")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
LONG = "a-filter-trained-on-the-third-floor-with-the-new-camera-v12b"
TIMEOUT = 120_000  # ms
SETTLE = 1200  # ms for animations to end

FROZEN = "faults=image_frozen%3Afrom%3D30&step=60"
LINKS = {
    "first": "",
    "push-field": f"?task=push-field&filter=information-ekf&{FROZEN}",
    "door-field": f"?task=door-field&filter=information-ekf&{FROZEN}",
    "push": f"?task=push&filter=crossmodal-ekf&{FROZEN}",
    "comparison": "?task=door&filter=crossmodal-pf&step=29&against=filter%3Dcrossmodal-ekf&tab=compare",
    "no-weights": "?task=push&filter=feature-ekf",
    "no-study": "?task=push-field&tab=study",
    "no-sweep": "?tab=experiments",
    "experiments-curves": "?tab=experiments&rows=seeds&x=level%3Ablackout&y=error",
    "one-sensor": "?task=well&step=40",
    "three-sensors": "?task=cart&step=40",
    "six-sensors": "?task=submarine&step=40",
    "external": "?task=door&filter=hand-on-arc&step=29",
    "no-record": "?task=door&filter=hand-on-arc&step=29&tab=diagnosis",
    "live": "?data=live:go",
    "bad-link": "?task=door&episode=4711&faults=blakout%3D0.4&filter=crossmodal-fp",
}
"""View -> address that opens it: the first visit, an injected fault on each task, a comparison run, a filter without
weights, a task without a study, no sweep, a sweep as curves, external filters of other tasks, one without a healthy
record, a run in progress, and a selection that does not exist."""

FIRST_VISIT = ("first", "no-sweep")
"""Views of a server without files of the user, which has an introduction with examples and no sweep."""

PENDING = {
    "loading": lambda route: None,
    "error": lambda route: route.fulfill(status=500, json={"error": "The filter failed: out of memory."}),
}
"""View -> answer of the server to a request for a trace."""


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


def job_running(page: Page) -> None:
    """Start a search for failures, which no other view has started, and open the list of jobs."""
    faults = f"force_bias%3D{time.time() % 5:.4f}"
    page.goto(
        f"{page.url.partition('?')[0]}?task=push&filter=unimodal-ekf&faults={faults}&tab=failures", timeout=TIMEOUT
    )
    page.locator("#failures").get_by_role("button", name="Search for failures", exact=True).click(timeout=TIMEOUT)
    page.evaluate("document.querySelector('#jobs-button').click()")


def slices(page: Page) -> None:
    """Open the slices of a field task and the worst step of the first one."""
    query = "?task=push-field&filter=information-ekf&tab=failures&list=slices"
    page.goto(page.url.partition("?")[0] + query, timeout=TIMEOUT)
    page.wait_for_function(USEFUL, timeout=TIMEOUT)
    tab("failures", state("#failures"), "Search for failures")(page)
    page.locator("#failures .slices .title").first.click()


def finetune(end: str, seed: int | None = None) -> Callable[[Page], None]:
    """Return a function that starts a fine-tuning run, or opens the one with this seed, and waits for a condition."""

    def show(page: Page) -> None:
        page.goto(f"{page.url.partition('?')[0]}?task=door&filter=crossmodal-ekf&tab=finetune", timeout=TIMEOUT)
        page.wait_for_function(f"() => {state('#finetune')}", timeout=TIMEOUT)
        page.locator("#finetune summary").click()
        page.locator("#finetune input[name=steps]").fill("50")
        page.locator("#finetune input[name=seed]").fill(str(int(time.time()) if seed is None else seed))
        page.locator("#finetune .start").click()
        page.wait_for_function(f"() => {end}", timeout=TIMEOUT)

    return show


VIEWS: dict[str, Callable[[Page], None]] = {
    "diagnosis": tab("diagnosis", "!['loading', 'active'].includes(diagnosis.dataset.state)"),
    "failures": tab("failures", state("#failures"), "Search for failures"),
    "compare": tab("compare", state("#compare .result"), "Compare"),
    "study": tab("study", state("#study")),
    "rerun": tab("rerun", "document.querySelector('#rerun').dataset.state !== 'loading'"),
    "layers": tab("scene", state("#scene"), "Layers…"),
    "maps-options": click("#maps-view"),
    "report": click("#report"),
    "keys": click("#help"),
    "jobs": click("#jobs-button"),
    "commands": click("#find"),
    "maps-several": click("#maps-tiles input[value=several]"),
    "slices": slices,
    "finetune-running": finetune("document.querySelector('#finetune .verdict').textContent.includes('step')"),
    "finetune-finished": finetune(state("#finetune article"), seed=0),
    "job": job_running,
}
"""View -> function that opens it; every tab is a view as well."""

USEFUL = "() => window.beliefscope?.stats.useful || document.querySelector('#finding').dataset.source === 'error'"
"""Condition: a run is displayed, or why there is none."""

READY = {
    "comparison": state("#compare .result"),
    "no-sweep": "experiments.dataset.state === 'empty'",
    "experiments-curves": state("#experiments"),
}
"""View in ``LINKS`` -> further condition."""

READ_ONLY_VIEWS = ("first", "diagnosis", "diagnostics", "finetune", "rerun", "recordings", "bad-link")
"""Views of a read-only server: the others need a computation."""


def close(page: Page) -> None:
    """Close dialogs and popovers, and pause a fine-tuning run."""
    page.evaluate(
        "() => { document.querySelector('dialog[open]')?.close();"
        " document.querySelector('[popover]:popover-open')?.hidePopover();"
        " if (!document.querySelector('#jobs').hidden) document.querySelector('#jobs-button').click();"
        " const pause = document.querySelector('#finetune article .doing button');"
        " if (pause?.textContent === 'Pause') pause.click(); }"
    )


def shoot(browser: Any, url: str, folder: Path, size: str, theme: str, wanted: Callable[[str], bool]) -> None:
    width, height = map(int, size.split("x"))
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=theme)
    page.goto(f"{url}?task=door&step=40", timeout=TIMEOUT)
    page.wait_for_function(USEFUL, timeout=TIMEOUT)
    page.wait_for_timeout(3 * SETTLE)
    tabs = [
        name.removeprefix("tab-") for name in page.eval_on_selector_all("[role=tab]", "all => all.map((t) => t.id)")
    ]
    for name in [*tabs, *(name for name in VIEWS if name not in tabs)]:
        if not wanted(name):
            continue
        VIEWS.get(name, tab(name))(page)
        page.wait_for_timeout(SETTLE)
        page.screenshot(path=folder / f"{name}-{size}-{theme}.png", timeout=TIMEOUT)
        close(page)
    for name, link in LINKS.items():
        if wanted(name):
            page.goto(url + link, timeout=TIMEOUT)
            page.wait_for_function(USEFUL, timeout=TIMEOUT)
            page.wait_for_function(f"() => {READY.get(name, 'true')}", timeout=TIMEOUT)
            page.wait_for_timeout(3 * SETTLE)
            page.screenshot(path=folder / f"{name}-{size}-{theme}.png", timeout=TIMEOUT)
    for name, answer in PENDING.items():
        if wanted(name):
            page.route("**/api/trace/**", answer)
            page.goto(f"{url}?task=push&step=20", timeout=TIMEOUT)
            page.wait_for_timeout(3 * SETTLE)
            page.screenshot(path=folder / f"{name}-{size}-{theme}.png", timeout=TIMEOUT)
            page.unroute("**/api/trace/**")
    page.close()


def run_small_sweep(folder: Path) -> None:
    """Filters of one task over a few episodes, with two levels of blackout and a force bias."""
    names = ("crossmodal-ekf", "image-ekf", "haptics-ekf", "unimodal-ekf")
    paths = tuple(pretrained_path("door", name) for name in names)
    faults = ("", "blackout=0.4", "blackout=0.8", "force_bias:x=8")
    with open_dataset(sample_path("door")) as data:
        episodes = tuple(data.held_out()[:6])
    run_sweep([replace(cell, episodes=episodes) for cell in Inputs(paths, faults=faults).cells()], folder)


@contextmanager
def live_run(workspace: Path) -> Iterator[None]:
    """Run a filter slowly enough that it still runs after the views before its own, while the screenshots are taken."""
    options = ["--filter", "crossmodal-ekf", "--rate", "0.25", "--name", "go", "--workspace", str(workspace)]
    process = subprocess.Popen(
        [sys.executable, "-m", "beliefscope", "live", "door", *options], stderr=subprocess.DEVNULL
    )
    try:
        while not (workspace / "live" / "go.live").exists() and process.poll() is None:
            time.sleep(0.1)
        yield
    finally:
        process.kill()
        process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--view", action="append", default=[], help="a tab or one of " + ", ".join([*VIEWS, *LINKS, *PENDING])
    )
    parser.add_argument("--size", action="append", choices=SIZES)
    parser.add_argument("--theme", action="append", choices=THEMES)
    parser.add_argument("--url", help="of a running server")
    parser.add_argument("--read-only", action="store_true", help="of a read-only server")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as files, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)

        def shoot_all(
            url: str, wanted: Callable[[str], bool] = lambda name: not args.view or name in args.view
        ) -> None:
            for size in args.size or SIZES:
                for theme in args.theme or THEMES:
                    shoot(browser, url, args.folder, size, theme, wanted)

        if args.url:
            shoot_all(args.url)
            return
        if args.read_only:
            with serving("--read-only") as server:
                args.view = args.view or list(READ_ONLY_VIEWS)
                shoot_all(server.url)
            return
        filter_ = shutil.copy(pretrained_path("door", "crossmodal-pf"), Path(files) / f"{LONG}.safetensors")
        data = shutil.copy(sample_path("door"), Path(files) / f"{LONG.replace('filter', 'set-of-doors')}.h5")
        workspace = Path(files) / "workspace"
        run_small_sweep(sweep := Path(files) / "sweep-of-doors")
        options = [
            "--filter",
            str(filter_),
            "--data",
            str(data),
            *sensor_rigs.options(Path(files)),
            "--sweep",
            str(sweep),
        ]
        with live_run(workspace), serving(*options, workspace=workspace) as server:
            shoot_all(server.url, lambda name: name not in FIRST_VISIT and (not args.view or name in args.view))
        if not args.view or set(FIRST_VISIT) & set(args.view):
            with serving() as server:
                shoot_all(server.url, lambda name: name in FIRST_VISIT)


if __name__ == "__main__":
    main()

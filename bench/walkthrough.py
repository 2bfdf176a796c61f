"""The pictures of README.md and docs/walkthrough.md, and the sentences that the page shows in them.

python bench/walkthrough.py [FOLDER]    # docs/images by default; needs Chromium and the package's [dev] extra
"""

from __future__ import annotations

import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from page import FLAGS, serving
from playwright.sync_api import Page, sync_playwright

IMAGES = Path(__file__).parents[1] / "docs" / "images"
MOMENT = {"task": "push", "filter": "crossmodal-ekf", "episode": 79, "step": 68, "component": "x"}
SIZE = {"width": 1440, "height": 900}
SETTLING = 10.0  # s: drawn without a graphics card, the scene fades in slowly
PATIENCE = 300.0  # s: integrated gradients take a while on a busy processor

FAULT_PRESETS = "#diagnostics article[data-state=ready] > .verdict"


@dataclass(frozen=True)
class Shot:
    """One picture: the page's address beside the moment's, the button to be pressed, where its sentence stands."""

    name: str
    asked: dict[str, Any]
    says: str
    press: str = ""


SHOTS = (
    Shot(
        "page",
        {
            "task": "door",
            "filter": "crossmodal-pf",
            "data": "sample",
            "episode": 9,
            "step": 25,
            "component": "angle",
            "faults": "blackout=0.4",
        },
        "#maps-pairs",
    ),
    Shot("walkthrough-failures", {"tab": "failures"}, "#failures[data-state=ready] .verdict", "Look for failures"),
    Shot("walkthrough-moment", {"tab": "scene"}, "#maps-pairs"),
    Shot("walkthrough-weights", {"tab": "diagnostics", "diagnostic": "weights"}, FAULT_PRESETS),
    Shot("walkthrough-shapley", {"tab": "diagnostics", "diagnostic": "shapley"}, FAULT_PRESETS, "Compute"),
    Shot(
        "walkthrough-saliency",
        {"tab": "diagnostics", "diagnostic": "saliency", "options": "step=68&target=beta:image"},
        FAULT_PRESETS,
        "Compute",
    ),
    Shot("walkthrough-edit", {"tab": "compare", "against": "from=30&to=76&weights=haptics=0"}, "#compare .verdict"),
)


def text(page: Page, selector: str) -> str:
    """What stands there; empty while nothing does."""
    found = page.locator(selector)
    return (found.text_content() or "").strip() if found.count() else ""


def take(page: Page, shot: Shot) -> str:
    """Waits until the shot's sentence is there, pressing its button where it is offered; returns the sentence."""
    end = time.monotonic() + PATIENCE
    pressed = False
    while not (said := text(page, shot.says)):
        button = page.locator(".doing:visible button", has_text=shot.press) if shot.press else None
        if button is not None and not pressed and button.count():
            button.first.click()
            pressed = True
        if time.monotonic() > end:
            raise TimeoutError(f"{shot.name}: nothing in {shot.says} within {PATIENCE:g} s")
        page.wait_for_timeout(200)
    # The moment's own maps and scene come after what was waited for.
    drawn = (
        f"() => beliefscope.stats.maps?.size === 135 && beliefscope.stats.maps.step === {(MOMENT | shot.asked)['step']}"
        " && (scene.offsetParent === null || scene.dataset.state === 'ready')"
    )
    while not page.evaluate(drawn):
        page.wait_for_timeout(200)
    page.wait_for_timeout(1000 * SETTLING)
    return said


def main(folder: Path = IMAGES) -> None:
    """Takes all pictures."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        sys.exit("Chromium is not installed")
    with serving() as server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for shot in SHOTS:
            page = browser.new_page(viewport=SIZE, color_scheme="light")
            page.goto(f"{server.url}?{urlencode(MOMENT | shot.asked)}", timeout=1000 * PATIENCE)
            print(f"{shot.name}: {take(page, shot)}", flush=True)
            page.screenshot(path=folder / f"{shot.name}.png", timeout=1000 * PATIENCE)
            page.close()
        browser.close()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))

"""Take the screenshots of README.md, docs/diagnose.md and docs/walkthrough.md, and print the verdicts in them.

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
SELECTION = {"task": "push", "filter": "crossmodal-ekf", "episode": 79, "step": 68, "component": "x"}
OUTAGE = {"task": "push-field", "filter": "information-ekf", "episode": 13, "step": 53, "weights": "effective"}
WITHOUT_HAPTICS = "from=54&to=86&weights=haptics=0"
FROZEN = {"episode": 9, "step": 50, "faults": "image_frozen:from=30", "tab": "diagnosis"}
SIZE = {"width": 1440, "height": 900}
SETTLING = 10.0  # s: software rendering of the scene is slow
TIMEOUT = 300.0  # s: integrated gradients are slow on a busy machine

READY = "#diagnostics article[data-state=ready] > .verdict"


@dataclass(frozen=True)
class Shot:
    """One screenshot: URL parameters added to the common selection, selector of the verdict, button to press."""

    name: str
    parameters: dict[str, Any]
    verdict: str
    press: str = ""


SHOTS = (
    Shot("page", OUTAGE, "#maps-colour-bar span"),
    Shot("walkthrough-outage", OUTAGE | {"tab": "compare", "against": WITHOUT_HAPTICS}, "#compare .verdict"),
    Shot("diagnosis", FROZEN, "#diagnosis[data-state=ready] .headline"),
    Shot("walkthrough-failures", {"tab": "failures"}, "#failures[data-state=ready] .verdict", "Search for failures"),
    Shot("walkthrough-moment", {"tab": "scene"}, "#maps-colour-bar span"),
    Shot("walkthrough-weights", {"tab": "diagnostics", "diagnostic": "weights"}, READY),
    Shot("walkthrough-standalone", {"tab": "diagnostics", "diagnostic": "standalone"}, READY, "Compute"),
    Shot("walkthrough-shapley", {"tab": "diagnostics", "diagnostic": "shapley"}, READY, "Compute"),
    Shot(
        "walkthrough-saliency",
        {"tab": "diagnostics", "diagnostic": "saliency", "options": "step=68&target=beta:image"},
        READY,
        "Compute",
    ),
    Shot(
        "walkthrough-intervention",
        {"tab": "compare", "against": "from=30&to=76&weights=haptics=0"},
        "#compare .verdict",
    ),
)


def text(page: Page, selector: str) -> str:
    """Text of an element; empty if it does not exist."""
    element = page.locator(selector)
    return (element.text_content() or "").strip() if element.count() else ""


def take(page: Page, shot: Shot) -> str:
    """Press the button if visible, wait for the verdict, and return it."""
    end = time.monotonic() + TIMEOUT
    pressed = False
    while not (verdict := text(page, shot.verdict)):
        button = page.locator(".doing:visible button", has_text=shot.press) if shot.press else None
        if button is not None and not pressed and button.count():
            button.first.click()
            pressed = True
        if time.monotonic() > end:
            raise TimeoutError(f"{shot.name}: nothing in {shot.verdict} within {TIMEOUT:g} s")
        page.wait_for_timeout(200)
    # Maps and scene of the step may arrive after the verdict.
    step = (SELECTION | shot.parameters)["step"]
    ready = (
        f"() => beliefscope.stats.maps?.size === 135 && beliefscope.stats.maps.step === {step}"
        " && (scene.offsetParent === null || scene.dataset.state === 'ready')"
    )
    while not page.evaluate(ready):
        page.wait_for_timeout(200)
    page.wait_for_timeout(1000 * SETTLING)
    return verdict


def main(folder: Path = IMAGES) -> None:
    """Take all screenshots."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        sys.exit("Chromium is not installed")
    with serving() as server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for shot in SHOTS:
            page = browser.new_page(viewport=SIZE, color_scheme="light")
            page.goto(f"{server.url}?{urlencode(SELECTION | shot.parameters)}", timeout=1000 * TIMEOUT)
            print(f"{shot.name}: {take(page, shot)}", flush=True)
            page.screenshot(path=folder / f"{shot.name}.png", timeout=1000 * TIMEOUT)
            page.close()
        browser.close()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))

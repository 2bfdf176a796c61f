"""Animation of the dashboard over a run of a field task, as an animated WebP image for the README.

python bench/animation.py docs/images/page.webp

Drives Chromium over the displayed run step by step, waits at each step until scene and maps are drawn, and stores the
screenshots, scaled down.
"""

from __future__ import annotations

import argparse
import io
import shutil
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright
from server_process import serving

FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
VIEWPORT = {"width": 1280, "height": 800}
WIDTH = 1000  # px, of the animation
TIMEOUT = 120_000  # ms
RUN = "?task=push-field&filter=information-ekf&episode=13&weights=effective"
STEPS = range(44, 100, 2)
"""The camera goes dark at step 54, in contact, and returns at step 86."""
DURATION = 220  # ms of a frame
LAST = 1500  # ms of the last one
QUALITY = 70
LARGEST = 4_000_000  # bytes

DRAWN = "(step) => beliefscope.stats.drawn?.step === step && beliefscope.stats.maps?.step === step"


def frames(url: str) -> list[Image.Image]:
    """Screenshots of the steps."""
    images = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport=VIEWPORT, color_scheme="light")
        page.add_init_script("localStorage.setItem('beliefscope.intro', 'closed')")
        page.goto(f"{url}{RUN}&step={STEPS[0]}", timeout=TIMEOUT)
        page.wait_for_function("() => window.beliefscope?.stats.maps?.size === 135", timeout=TIMEOUT)
        for step in STEPS:
            while page.evaluate("() => beliefscope.state().step") < step:
                page.keyboard.press("ArrowRight")
            page.wait_for_function(DRAWN, arg=step, timeout=TIMEOUT)
            page.wait_for_timeout(700)  # the browser renders the scene after it arrived
            image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
            images.append(image.resize((WIDTH, WIDTH * image.height // image.width), Image.Resampling.LANCZOS))
        browser.close()
    return images


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("output", type=Path, help="WebP file")
    args = parser.parse_args()
    with serving() as server:
        first, *others = frames(server.url)
    durations = [DURATION] * len(others) + [LAST]
    first.save(args.output, save_all=True, append_images=others, duration=durations, loop=0, quality=QUALITY, method=6)
    size = args.output.stat().st_size
    print(f"{args.output}: {len(durations)} frames, {first.width} x {first.height}, {size / 1e6:.2f} MB")
    assert size <= LARGEST


if __name__ == "__main__":
    main()

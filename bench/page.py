"""The page in headless Chromium: how soon it is usable, how long from a key to the maps drawn, how smooth a drag is."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from subject import STEPS, Row, episode

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.store import write_dataset

KEYS = 200
SWEEP = 3.0  # s that a drag over the time line takes
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]


@contextmanager
def serving() -> Iterator[str]:
    """The installed command on a free port; yields the page's address once it listens."""
    with tempfile.TemporaryDirectory() as workspace:
        long = Path(workspace) / "long.h5"
        write_dataset(long, find_task("door"), [episode()])
        command = [sys.executable, "-m", "beliefscope", "serve", "--port", "0", "--no-open", "--workspace", workspace]
        command += ["--data", str(long)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        try:
            assert process.stdout is not None
            for line in process.stdout:
                found = re.search(r"http://\S+", line)
                if found:
                    yield found[0]
                    return
            raise RuntimeError("the server ended before it listened")
        finally:
            process.terminate()
            process.wait(timeout=20)


DRAG = """([seconds, from, to, y]) => new Promise((done) => {
  const [body, cursor] = ['#timeline .body', '#tracks .mark.cursor'].map((part) => document.querySelector(part));
  const began = performance.now();
  const drawn = [];
  let before = '';
  const share = () => (performance.now() - began) / (1000 * seconds);
  const hand = setInterval(() => {
    const clientX = from + (to - from) * share();
    const moved = { pointerId: 1, bubbles: true, buttons: 1, clientX, clientY: y };
    body.dispatchEvent(new PointerEvent('pointermove', moved));
  }, 4);
  const frame = (now) => {
    if (cursor.style.transform !== before) drawn.push(now);
    before = cursor.style.transform;
    if (share() < 1) return requestAnimationFrame(frame);
    clearInterval(hand);
    done(drawn);
  };
  requestAnimationFrame(frame);
})"""
"""Moves the hand that holds the cursor much more often than frames come; when frames with a moved cursor came, ms."""


def measure() -> list[Row]:
    browser = next((b for b in ("chromium", "chromium-browser", "google-chrome") if shutil.which(b)), None)
    if browser is None:
        return [("page", "skipped: no Chromium on the path", "")]
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return [("page", "skipped: playwright is not installed", "")]
    rows: list[Row] = []
    with serving() as url, sync_playwright() as playwright:
        listening = time.perf_counter()
        chromium = playwright.chromium.launch(executable_path=shutil.which(browser), args=FLAGS)
        page = chromium.new_page(viewport={"width": 1440, "height": 900})
        launched = time.perf_counter()
        page.goto(url + "?data=sample")
        page.wait_for_function("() => window.beliefscope?.stats.maps", timeout=60_000)
        usable = time.perf_counter()
        rows.append(("from listening to maps drawn, browser's start left out", f"{usable - launched:.2f} s", "<= 3 s"))
        rows.append(("of this machine's browser: its start", f"{launched - listening:.2f} s", ""))
        page.wait_for_timeout(10_000)  # until the server has prepared the Rerun viewer, once a workspace
        page.evaluate("window.beliefscope.stats.scrub.length = 0")
        for number in range(KEYS):
            page.keyboard.press("ArrowRight" if number // 40 % 2 == 0 else "ArrowLeft")
            page.wait_for_timeout(60)
        page.wait_for_timeout(500)
        took = np.array(page.evaluate("window.beliefscope.stats.scrub"))
        p50, p95 = np.percentile(took, [50, 95])
        rows.append((f"key to maps drawn, {len(took)} of {KEYS} keys, p50", f"{p50:.0f} ms", ""))
        rows.append((f"key to maps drawn, {len(took)} of {KEYS} keys, p95", f"{p95:.0f} ms", "<= 100 ms"))
        page.goto(url + "?data=long")
        page.wait_for_function("() => window.beliefscope?.stats.maps", timeout=60_000)
        page.wait_for_timeout(2000)
        box = page.locator("#tracks").bounding_box()
        assert box is not None
        left, right, y = box["x"] + 0.3 * box["width"], box["x"] + 0.95 * box["width"], box["y"] + 60
        page.mouse.move(left, y)
        page.mouse.down()
        apart = np.diff(page.evaluate(DRAG, [SWEEP, left, right, y]))
        page.mouse.up()
        rows.append((f"dragging over {STEPS} steps, time line drawn", f"{1000 / apart.mean():.0f} /s", ">= 30 /s"))
        rows.append(("dragging, between two drawings, p95", f"{np.percentile(apart, 95):.0f} ms", ""))
        chromium.close()
    return rows

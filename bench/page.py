"""The page in headless Chromium: how soon it is usable, and how long from a key to the maps drawn."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from subject import Row

KEYS = 200
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]


@contextmanager
def serving() -> Iterator[str]:
    """The installed command on a free port; yields the page's address once it listens."""
    with tempfile.TemporaryDirectory() as workspace:
        command = [sys.executable, "-m", "beliefscope", "serve", "--port", "0", "--no-open", "--workspace", workspace]
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
        page.goto(url)
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
        chromium.close()
    return rows

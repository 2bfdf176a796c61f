"""The page in headless Chromium: first paint, finding, layout shift, latency, diagnosis, scene, memory in playback.

python bench/page.py                # all but the playback
python bench/page.py --diagnosis    # only the diagnosis
python bench/page.py --first        # only the first screen and the 3D scene
python bench/page.py --keys         # only the keys
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
from server_process import serving
from subject import STEPS, Row, episode

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.store import write_dataset

KEYS = 200
SINGLE_KEYS = 40
VISITS = 5
DIAGNOSED = (
    ("door", "crossmodal-ekf"),
    ("door", "crossmodal-pf"),
    ("push", "crossmodal-ekf"),
    ("push", "crossmodal-pf"),
)
FROZEN = "image_frozen:from=10"
SWEEP = 3.0  # s, duration of a drag over the timeline
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]


@contextmanager
def browsing() -> Iterator[Any]:
    """Open a page in a new browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=find_chromium(), args=FLAGS)
        yield chromium.new_page(viewport={"width": 1440, "height": 900})
        chromium.close()


def find_chromium() -> str | None:
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def usable(page: Any) -> float:
    """Wait until the timeline and the first maps are drawn; return the seconds since the page started."""
    page.wait_for_function("() => window.beliefscope?.stats.useful", timeout=120_000)
    return float(page.evaluate("window.beliefscope.stats.useful")) / 1e3


DRAG = """([seconds, from, to, y]) => new Promise((done) => {
  const [body, cursor] = ['#timeline .body', '#tracks .mark.cursor'].map((part) => document.querySelector(part));
  const start = performance.now();
  const drawn = [];
  let before = '';
  const share = () => (performance.now() - start) / (1000 * seconds);
  const timer = setInterval(() => {
    const clientX = from + (to - from) * share();
    const options = { pointerId: 1, bubbles: true, buttons: 1, clientX, clientY: y };
    body.dispatchEvent(new PointerEvent('pointermove', options));
  }, 4);
  const frame = (now) => {
    if (cursor.style.transform !== before) drawn.push(now);
    before = cursor.style.transform;
    if (share() < 1) return requestAnimationFrame(frame);
    clearInterval(timer);
    done(drawn);
  };
  requestAnimationFrame(frame);
})"""
"""Moves the pointer more often than the frame rate; returns the times of frames with a moved cursor, ms."""

WATCH = """() => {
  window.layoutShift = 0;
  window.findingTime = null;
  new PerformanceObserver((list) => {
    for (const { value, hadRecentInput } of list.getEntries()) if (!hadRecentInput) layoutShift += value;
  }).observe({ type: 'layout-shift', buffered: true });
  const look = () => {
    if (document.querySelector('#finding')?.dataset.source) findingTime = performance.now();
    else requestAnimationFrame(look);
  };
  addEventListener('DOMContentLoaded', look);
}"""
"""Sums the layout shifts of a page and notes when its finding is on the screen, ms."""

RENDERINGS = """(seconds) => new Promise((done) => {
  const { WebGL2RenderingContext, requestAnimationFrame } = document.querySelector('#scene iframe').contentWindow;
  const { clear } = WebGL2RenderingContext.prototype;
  let count = 0;
  let inFrame = false;
  WebGL2RenderingContext.prototype.clear = function (mask) {
    if (!inFrame) count++;
    inFrame = true;
    requestAnimationFrame(() => (inFrame = false));
    return clear.call(this, mask);
  };
  setTimeout(() => {
    WebGL2RenderingContext.prototype.clear = clear;
    done(count / seconds);
  }, 1000 * seconds);
})"""
"""Counts the frames that the 3D scene renders, per second."""


RENDERED = """() => {
  window.renderedScenes = [];
  const scene = document.querySelector('#scene iframe').contentWindow;
  const { clear } = scene.WebGL2RenderingContext.prototype;
  let [input, sent] = [null, 0];
  addEventListener('keydown', ({ timeStamp }) => {
    input = timeStamp;
    sent = beliefscope.stats.scene.length;
  }, true);
  scene.WebGL2RenderingContext.prototype.clear = function (mask) {
    if (input !== null && beliefscope.stats.scene.length > sent) {
      const start = input;
      input = null;
      scene.setTimeout(() => renderedScenes.push(performance.now() - start));
    }
    return clear.call(this, mask);
  };
}"""
"""Lists the times from a key to the end of the first rendering that starts after its scene was sent, ms."""


def measure() -> list[Row]:
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return [("page", "skipped: playwright is not installed", "")]
    if find_chromium() is None:
        return [("page", "skipped: no Chromium on the path", "")]
    with browsing() as page, serving() as served:
        url = served.url
        rows = [*paint(page, url), *first_screen(page, url), *scene(page, url), *diagnosis(page, url)]
    with tempfile.TemporaryDirectory() as folder:
        long = Path(folder) / "long.h5"
        write_dataset(long, find_task("door"), [episode()])
        with browsing() as page, serving("--data", str(long)) as served:
            return [*rows, *keys(page, served.url), *drag(page, served.url)]


def paint(page: Any, url: str) -> list[Row]:
    """Time until the page is usable: with a fresh server, after a reload, and for a new browser."""
    page.goto(url, wait_until="commit")
    rows = [("timeline and maps with a fresh server", f"{usable(page):.2f} s", "<= 3 s")]
    page.wait_for_timeout(10_000)  # the server prepares the Rerun viewer, once per workspace
    reloads, visits = [], []
    for _ in range(VISITS):
        page.reload(wait_until="commit")
        reloads.append(usable(page))
    page.goto("about:blank")  # its 3D scene would load at the same time
    for _ in range(VISITS):
        with page.context.browser.new_context(viewport=page.viewport_size) as context:
            other = context.new_page()
            other.goto(url, wait_until="commit")
            visits.append(usable(other))
    for case, times in (("a reload", reloads), ("a browser's first visit", visits)):
        rows.append((f"timeline and maps after {case}, median of {VISITS}", f"{np.median(times):.2f} s", "<= 1.5 s"))
    return rows


def first_screen(page: Any, url: str) -> list[Row]:
    """Time until the finding is on the screen and layout shift, for new browsers."""
    times, shifts = [], []
    for _ in range(VISITS):
        with page.context.browser.new_context(viewport={"width": 1280, "height": 720}) as context:
            other = context.new_page()
            other.add_init_script(f"({WATCH})()")
            other.goto(url, wait_until="commit")
            usable(other)
            other.wait_for_timeout(3000)  # the 3D scene and the diagnosis follow
            times.append(other.evaluate("findingTime") / 1e3)
            shifts.append(other.evaluate("layoutShift"))
    return [
        (f"finding on the screen at 1280 x 720, median of {VISITS}", f"{np.median(times):.2f} s", "<= 2.5 s"),
        (f"layout shift of a first visit, maximum of {VISITS}", f"{max(shifts):.4f}", "<= 0.01"),
    ]


def scene(page: Any, url: str) -> list[Row]:
    """Frames of the 3D scene during playback."""
    page.goto(url)
    usable(page)
    page.evaluate("document.querySelector('#tab-scene').click()")
    page.wait_for_function("() => beliefscope.stats.drawn", timeout=120_000)
    page.wait_for_timeout(5000)
    page.keyboard.press("Space")
    page.wait_for_timeout(1000)
    return [("3D scene during playback, rendered in software", f"{page.evaluate(RENDERINGS, 10):.1f} frames/s", ">= 5")]


def keys(page: Any, url: str) -> list[Row]:
    """Latency from a key to the drawn maps and the 3D scene."""
    page.goto(url)
    usable(page)
    page.wait_for_timeout(3000)
    page.evaluate("window.beliefscope.stats.scrub.length = 0")
    for number in range(KEYS):
        page.keyboard.press("ArrowRight" if number // 40 % 2 == 0 else "ArrowLeft")
        page.wait_for_timeout(60)
    page.wait_for_timeout(500)
    times = np.array(page.evaluate("window.beliefscope.stats.scrub"))
    p50, p95 = np.percentile(times, [50, 95])
    return [
        (f"key to maps drawn, {len(times)} of {KEYS} keys, p50", f"{p50:.0f} ms", ""),
        (f"key to maps drawn, {len(times)} of {KEYS} keys, p95", f"{p95:.0f} ms", "<= 50 ms"),
        *scene_keys(page),
    ]


def scene_keys(page: Any) -> list[Row]:
    """Latency from single keys to the 3D scene: until the server has sent it, and until the browser has rendered it."""
    page.wait_for_timeout(2000)
    page.evaluate(RENDERED)
    page.evaluate("window.beliefscope.stats.scene.length = 0")
    for _ in range(SINGLE_KEYS):
        page.keyboard.press("ArrowRight")
        page.wait_for_timeout(800)
    rows = []
    for case, list_, bar in (
        ("sent", "beliefscope.stats.scene", "<= 100 ms"),
        ("rendered", "renderedScenes", ""),
    ):
        times = np.array(page.evaluate(f"window.{list_}"))
        for percentile, limit in ((50, ""), (95, bar)):
            name = f"single key to scene {case}, {len(times)} of {SINGLE_KEYS} keys, p{percentile}"
            rows.append((name, f"{np.percentile(times, percentile):.0f} ms" if len(times) else "no scene", limit))
    return rows


def diagnosis(page: Any, url: str) -> list[Row]:
    """Time from the key that opens the Diagnosis tab to the preliminary headline, and to the confirmed diagnosis."""
    rows: list[Row] = []
    for task, filter_ in DIAGNOSED:
        page.goto(f"{url}?" + urlencode({"task": task, "filter": filter_, "faults": FROZEN, "tab": "compare"}))
        usable(page)
        page.wait_for_timeout(3000)
        start = time.perf_counter()
        page.keyboard.press("g")
        page.wait_for_function("() => diagnosis.dataset.finding")
        first = time.perf_counter() - start
        page.wait_for_function("() => diagnosis.dataset.state === 'ready'", timeout=120_000)
        confirmed = time.perf_counter() - start
        rows.append((f"key to headline, {task} {filter_}", f"{first:.2f} s", "<= 3 s"))
        rows.append((f"key to confirmed diagnosis, {task} {filter_}", f"{confirmed:.1f} s", ""))
    return rows


def drag(page: Any, url: str) -> list[Row]:
    """Drag over a long episode."""
    page.goto(url + "?data=long")
    usable(page)
    page.wait_for_timeout(2000)
    box = page.locator("#tracks").bounding_box()
    assert box is not None
    left, right, y = box["x"] + 0.3 * box["width"], box["x"] + 0.95 * box["width"], box["y"] + 60
    page.mouse.move(left, y)
    page.mouse.down()
    intervals = np.diff(page.evaluate(DRAG, [SWEEP, left, right, y]))
    page.mouse.up()
    return [
        (f"dragging over {STEPS} steps, timeline updates", f"{1000 / intervals.mean():.0f} /s", ">= 30 /s"),
        ("dragging, time between updates, p95", f"{np.percentile(intervals, 95):.0f} ms", ""),
    ]


def play(minutes: float) -> list[Row]:
    """Memory of scripts after garbage collection, nodes and listeners of a playing page."""
    with browsing() as page, serving() as served:
        page.goto(served.url)
        usable(page)
        devtools = page.context.new_cdp_session(page)
        devtools.send("Performance.enable")
        samples: list[tuple[float, ...]] = []
        start = time.monotonic()
        while (passed := time.monotonic() - start) < 60 * minutes:
            if not page.evaluate("window.beliefscope.state().playing"):
                page.keyboard.press("Space")
            page.wait_for_timeout(10_000)
            devtools.send("HeapProfiler.collectGarbage")
            metrics = {m["name"]: m["value"] for m in devtools.send("Performance.getMetrics")["metrics"]}
            samples.append(
                (passed / 60, metrics["JSHeapUsedSize"] / 1e6, metrics["Nodes"], metrics["JSEventListeners"])
            )
    values = np.array(samples)[len(samples) // 4 :]  # without the warm-up
    rows: list[Row] = []
    for column, quantity, unit in ((1, "memory of scripts", "MB"), (2, "nodes", ""), (3, "listeners", "")):
        rise = np.polyfit(values[:, 0], values[:, column], 1)[0]
        first, last = values[0, column], values[-1, column]
        rows.append(
            (
                f"{quantity} over {minutes:g} min of playback",
                f"{first:.1f} to {last:.1f} {unit}; {rise:+.2f} a minute",
                "flat",
            )
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--play", type=float, metavar="MINUTES", help="only measure the memory during playback")
    parser.add_argument("--first", action="store_true", help="only measure the first screen and the 3D scene")
    parser.add_argument("--diagnosis", action="store_true", help="only measure the diagnosis")
    parser.add_argument("--keys", action="store_true", help="only measure the keys, on a sample episode")
    args = parser.parse_args()
    if args.first:
        with browsing() as page, serving() as served:
            rows = [*first_screen(page, served.url), *scene(page, served.url)]
    elif args.keys:
        with browsing() as page, serving() as served:
            rows = keys(page, served.url)
    elif args.diagnosis:
        with browsing() as page, serving() as served:
            rows = diagnosis(page, served.url)
    else:
        rows = measure() if args.play is None else play(args.play)
    for quantity, measured, bar in rows:
        print(f"{quantity}: {measured}{bar and f' (bar: {bar})'}", flush=True)


if __name__ == "__main__":
    main()

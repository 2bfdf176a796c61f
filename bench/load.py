"""How answers slow down as browsers come: 1 to 32 that scrub at once, with and without a job beside them.

    python bench/load.py                        the curve
    python bench/load.py --job                  the same with a job running
    python bench/load.py --counts 8 --real 2    8 raw browsers and 2 of Chromium

Each browser scrubs an episode of its own with the default filter: 3 s at 30 moves a second, then it rests for 1 s.
Before that it has had its page open for 5 s (``--look``), in which the server makes maps ahead.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import numpy as np
from browsers import Browser, Selection
from rich.console import Console
from rich.table import Table
from served import Served, serving

RATE, MOVES, REST = 30.0, 90, 1.0
LIMIT = 64  # views that the server may open
COLUMNS = ("browsers", "p50", "p95", "p99", "x one", "scene p95", "answers/s", "fairness", "processor", "memory", "job")


async def one(browser: Browser, selection: Selection, until: float, seed: int) -> None:
    """Scrubs back and forth from a step of its own until that time."""
    steps = await browser.load(selection)
    at = seed * 7 % steps
    while time.perf_counter() < until:
        turn = at // (steps - 1) % 2
        path = [abs(turn * (steps - 1) - (at + i) % (steps - 1)) for i in range(MOVES)]
        at += MOVES
        await browser.drag(selection, path, RATE)
        await asyncio.sleep(REST)


async def measure(
    served: Served, count: int, seconds: float, job: bool, real: int, look: float = 5.0
) -> dict[str, Any]:
    """One point of the curve."""
    async with httpx.AsyncClient(base_url=served.url, headers={"Origin": served.url.rstrip("/")}, timeout=60) as http:
        task = (await http.get("/api/catalog")).json()["tasks"][0]
        data = task["data"][0]
        common = {"task": task["name"], "filter": task["filters"][0]["name"], "data": data["name"], "faults": ""}
        selections = [{**common, "episode": one["index"]} for one in data["episodes"]]
        browsers = [Browser(served.url) for _ in range(count)]
        for browser, selection in zip(browsers, selections, strict=False):
            await browser.open()
            await browser.load(selection)
            await browser.drag(selection, range(5), RATE)  # the scene is built
            browser.scrubs.clear()
            browser.scenes.clear()
        await asyncio.sleep(look)
        working = await _job(http, common) if job else None
        before, driver, began = served.processor, time.process_time(), time.perf_counter()
        chromium = asyncio.get_running_loop().run_in_executor(None, _real, served.url, real, seconds) if real else None
        scrubbing = [one(b, s, began + seconds, i) for i, (b, s) in enumerate(zip(browsers, selections, strict=False))]
        await asyncio.gather(*scrubbing)
        took = time.perf_counter() - began
        found = {
            "scrubs": [browser.scrubs for browser in browsers],
            "scenes": [t for browser in browsers for t in browser.scenes],
            "seconds": took,
            "processor": (served.processor - before) / took,
            "driver": (time.process_time() - driver) / took,
            "memory": served.memory,
            "errors": [line for browser in browsers for line in browser.errors],
            "real": await chromium if chromium else [],
            "job": (await http.get(f"/api/jobs/{working}")).json()["state"] if working else "",
        }
        for browser in browsers:
            await browser.end()
        if working:
            await http.delete(f"/api/jobs/{working}")
        return found


async def _job(http: httpx.AsyncClient, common: dict[str, Any]) -> str:
    """Failures over a whole data set: minutes of work in a process of its own."""
    query = {"data": common["data"], "among": "all", "faults": f"blackout={time.time() % 1:.6f}"}
    path = f"/api/failures/{common['task']}/{common['filter']}"
    return str((await http.post(path, params=query)).json()["job"]["id"])


def _real(url: str, count: int, seconds: float) -> list[float]:
    """s from input to maps drawn on so many pages of real browsers, which play meanwhile."""
    with ThreadPoolExecutor(count) as pool:
        return [t for found in pool.map(_one_real, [url] * count, [seconds] * count) for t in found]


def _one_real(url: str, seconds: float) -> list[float]:
    from page import browsing, usable

    with browsing() as page:
        page.goto(url)
        usable(page)
        page.evaluate("window.beliefscope.stats.scrub.length = 0")
        until = time.perf_counter() + seconds
        number = 0
        while time.perf_counter() < until:
            page.keyboard.press("ArrowRight" if number // 40 % 2 == 0 else "ArrowLeft")
            page.wait_for_timeout(33)
            number += 1
        return [t / 1e3 for t in page.evaluate("window.beliefscope.stats.scrub")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 4, 8, 16, 32], metavar="N")
    parser.add_argument("--seconds", type=float, default=12.0, help="for each of them")
    parser.add_argument("--real", type=int, default=0, metavar="N", help="pages in Chromium beside them")
    parser.add_argument("--look", type=float, default=5.0, help="s that pages have been open when hands begin to move")
    parser.add_argument("--job", action="store_true", help="with a job running beside them")
    asked = parser.parse_args()
    table = Table(*COLUMNS, title="s of a hand's move to its maps: ms", title_justify="left")
    first = None
    with serving("--views", str(LIMIT)) as served:
        time.sleep(8.0)  # until it has prepared what it prepares at the start
        for count in asked.counts:
            found = asyncio.run(measure(served, count, asked.seconds, asked.job, asked.real, asked.look))
            every = [t for scrubs in found["scrubs"] for t in scrubs]
            p50, p95, p99 = 1e3 * np.percentile(every, [50, 95, 99])
            first = first or p95
            shares = [len(scrubs) for scrubs in found["scrubs"]]
            table.add_row(
                str(count),
                *(f"{p:.0f}" for p in (p50, p95, p99)),
                f"{p95 / first:.1f}",
                f"{1e3 * np.percentile(found['scenes'], 95):.0f}" if found["scenes"] else "-",
                f"{len(every) / found['seconds']:.0f}",
                f"{min(shares) / max(shares):.2f}",
                f"{found['processor']:.2f} (driver {found['driver']:.2f})",
                f"{found['memory']:.0f} MB",
                found["job"] or "-",
            )
            if found["real"]:
                real = 1e3 * np.percentile(found["real"], [50, 95])
                print(f"{asked.real} of Chromium beside {count}: p50 {real[0]:.0f}, p95 {real[1]:.0f} ms, drawn")
            if found["errors"]:
                print(f"{count}: {len(found['errors'])} errors, such as: {found['errors'][0]}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()

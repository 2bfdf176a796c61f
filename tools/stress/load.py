"""Latency for 1 to 32 browsers that scrub at once, with and without a job.

    python tools/stress/load.py                        all counts
    python tools/stress/load.py --job                  the same with a job running
    python tools/stress/load.py --counts 8 --real 2    8 simulated browsers and 2 Chromium

Each browser scrubs its own episode with the default filter: 3 s at 30 moves a second, then 1 s of rest. Before that its
page is open for 5 s (``--look``), in which the server prefetches maps.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bench"))

import httpx
import numpy as np
from browsers import Browser, Selection
from rich.console import Console
from rich.table import Table
from server_process import Served, serving

RATE, MOVES, REST = 30.0, 90, 1.0
LIMIT = 64  # largest number of views of the server
COLUMNS = ("browsers", "p50", "p95", "p99", "/ one", "scene p95", "answers/s", "fairness", "CPU", "memory", "job")


async def scrub(browser: Browser, selection: Selection, until: float, seed: int) -> None:
    """Scrub back and forth until the given time."""
    steps = await browser.load(selection)
    position = seed * 7 % steps
    while time.perf_counter() < until:
        turn = position // (steps - 1) % 2
        path = [abs(turn * (steps - 1) - (position + i) % (steps - 1)) for i in range(MOVES)]
        position += MOVES
        await browser.drag(selection, path, RATE)
        await asyncio.sleep(REST)


async def measure(
    served: Served, count: int, seconds: float, job: bool, real: int, look: float = 5.0
) -> dict[str, Any]:
    """Measure one number of browsers."""
    async with httpx.AsyncClient(base_url=served.url, headers={"Origin": served.url.rstrip("/")}, timeout=60) as http:
        task = (await http.get("/api/catalog")).json()["tasks"][0]
        data = task["data"][0]
        common = {"task": task["name"], "filter": task["filters"][0]["name"], "data": data["name"], "faults": ""}
        selections = [{**common, "episode": episode["index"]} for episode in data["episodes"]]
        browsers = [Browser(served.url) for _ in range(count)]
        for browser, selection in zip(browsers, selections, strict=False):
            await browser.open()
            await browser.load(selection)
            await browser.drag(selection, range(5), RATE)  # builds the scene
            browser.scrubs.clear()
            browser.scenes.clear()
        await asyncio.sleep(look)
        job_id = await _job(http, common) if job else None
        before, driver, start = served.cpu, time.process_time(), time.perf_counter()
        chromium = asyncio.get_running_loop().run_in_executor(None, _real, served.url, real, seconds) if real else None
        scrubbing = [
            scrub(b, s, start + seconds, i) for i, (b, s) in enumerate(zip(browsers, selections, strict=False))
        ]
        await asyncio.gather(*scrubbing)
        duration = time.perf_counter() - start
        result = {
            "scrubs": [browser.scrubs for browser in browsers],
            "scenes": [t for browser in browsers for t in browser.scenes],
            "seconds": duration,
            "cpu": (served.cpu - before) / duration,
            "driver": (time.process_time() - driver) / duration,
            "memory": served.memory,
            "errors": [line for browser in browsers for line in browser.errors],
            "real": await chromium if chromium else [],
            "job": (await http.get(f"/api/jobs/{job_id}")).json()["state"] if job_id else "",
        }
        for browser in browsers:
            await browser.end()
        if job_id:
            await http.delete(f"/api/jobs/{job_id}")
        return result


async def _job(http: httpx.AsyncClient, common: dict[str, Any]) -> str:
    """Start a job that takes minutes: the failures over all episodes."""
    query = {"data": common["data"], "among": "all", "faults": f"blackout={time.time() % 1:.6f}"}
    path = f"/api/failures/{common['task']}/{common['filter']}"
    return str((await http.post(path, params=query)).json()["job"]["id"])


def _real(url: str, count: int, seconds: float) -> list[float]:
    """s from input to drawn maps on the given number of Chromium pages."""
    with ThreadPoolExecutor(count) as pool:
        return [t for times in pool.map(_real_page, [url] * count, [seconds] * count) for t in times]


def _real_page(url: str, seconds: float) -> list[float]:
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
    parser.add_argument("--seconds", type=float, default=12.0, help="duration for each count")
    parser.add_argument("--real", type=int, default=0, metavar="N", help="additional Chromium pages")
    parser.add_argument("--look", type=float, default=5.0, help="s from opening the pages to scrubbing")
    parser.add_argument("--job", action="store_true", help="with a job running")
    args = parser.parse_args()
    table = Table(*COLUMNS, title="Latency from a cursor move to its maps, ms", title_justify="left")
    first = None
    with serving("--views", str(LIMIT)) as served:
        time.sleep(8.0)  # for the preparations at startup
        for count in args.counts:
            result = asyncio.run(measure(served, count, args.seconds, args.job, args.real, args.look))
            every = [t for scrubs in result["scrubs"] for t in scrubs]
            p50, p95, p99 = 1e3 * np.percentile(every, [50, 95, 99])
            first = first or p95
            shares = [len(scrubs) for scrubs in result["scrubs"]]
            table.add_row(
                str(count),
                *(f"{p:.0f}" for p in (p50, p95, p99)),
                f"{p95 / first:.1f}",
                f"{1e3 * np.percentile(result['scenes'], 95):.0f}" if result["scenes"] else "-",
                f"{len(every) / result['seconds']:.0f}",
                f"{min(shares) / max(shares):.2f}",
                f"{result['cpu']:.2f} (driver {result['driver']:.2f})",
                f"{result['memory']:.0f} MB",
                result["job"] or "-",
            )
            if result["real"]:
                real = 1e3 * np.percentile(result["real"], [50, 95])
                print(f"{args.real} Chromium with {count} simulated: p50 {real[0]:.0f}, p95 {real[1]:.0f} ms, drawn")
            if result["errors"]:
                print(f"{count}: {len(result['errors'])} errors, such as: {result['errors'][0]}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()

"""Hours of use at a low rate, and whether the server's memory and descriptors stay flat.

    python bench/soak.py --hours 2 --out soak.csv

A few raw browsers select random filters, episodes and faults, scrub, rest, record, ask for jobs and cancel them, and
leave, politely or not. Every 10 s a line of the CSV tells what the server takes. At the end straight lines are fitted
to what came after the warm-up.
"""

from __future__ import annotations

import argparse
import asyncio
import csv
import random
import sys
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from browsers import Browser, Selection, trace_path
from served import Served, serving

EVERY = 10.0  # s between two samples
WARM_UP = 0.25  # of the time
BLOCKS = 10
COLUMNS = ("hours", "memory_mb", "descriptors", "threads", "views", "processor_s", "scrubs", "p50_ms", "p95_ms", "done")


class Soak:
    """The browsers and what they have met.

    Args:
        rest: mean s that a hand rests between two things it does.
    """

    def __init__(self, served: Served, rest: float, seed: int) -> None:
        self.served = served
        self.rest = rest
        self.random = random.Random(seed)
        self.done: dict[str, int] = {}
        self.wrong: list[str] = []
        self.views = 0
        self.browsers: list[Browser] = []
        self.catalog: dict[str, Any] = {}
        self.quick: list[str] = []
        self.slow: list[str] = []

    async def run(self, browsers: int, hours: float, out: Path) -> np.ndarray[Any, Any]:
        async with httpx.AsyncClient(base_url=self.served.url, timeout=120.0) as http:
            self.catalog = (await http.get("/api/catalog")).json()
            entries = (await http.get("/api/diagnostics")).json()
            self.quick = [entry["name"] for entry in entries if not entry["slow"]]
            self.slow = [entry["name"] for entry in entries if entry["slow"]]
        living = [asyncio.create_task(self._live()) for _ in range(browsers)]
        rows = []
        began = time.monotonic()
        try:
            with out.open("w", newline="") as file:
                writer = csv.writer(file)
                writer.writerow(COLUMNS)
                while (passed := time.monotonic() - began) < 3600 * hours:
                    rows.append(self._sample(passed / 3600))
                    writer.writerow([f"{value:.4g}" if isinstance(value, float) else value for value in rows[-1]])
                    file.flush()
                    await asyncio.sleep(EVERY)
        finally:
            for task in living:
                task.cancel()
            await asyncio.gather(*living, return_exceptions=True)
        return np.array(rows, dtype=float)

    def _sample(self, hours: float) -> tuple[float, ...]:
        took = [t for browser in self.browsers for t in browser.scrubs]
        for browser in self.browsers:
            browser.scrubs.clear()
            browser.scenes.clear()
        p50, p95 = 1e3 * np.percentile(took, [50, 95]) if took else (np.nan, np.nan)
        served, done = self.served, sum(self.done.values())
        use = (served.memory, served.descriptors, served.threads, self.views, served.processor)
        return (hours, *use, len(took), float(p50), float(p95), done)

    async def _live(self) -> None:
        """One person, who comes and goes."""
        browser = Browser(self.served.url)
        self.browsers.append(browser)
        try:
            while True:
                await self._guarded(self._visit(browser))
                await self._pause()
        finally:
            await browser.end()

    async def _visit(self, browser: Browser) -> None:
        await browser.open(scene=self.random.random() < 0.8)
        self.views += 1
        try:
            for _ in range(self.random.randint(1, 3)):
                await self._look(browser)
                await self._pause()
        finally:
            vanish = self.random.random() < 0.3
            self._count("vanished" if vanish else "left")
            self.views -= 1
            await browser.close(vanish)

    async def _look(self, browser: Browser) -> None:
        selection = self._any()
        steps = await browser.load(selection)
        self._count("looked")
        for _ in range(self.random.randint(1, 4)):
            at = self.random.randrange(steps)
            far = self.random.choice((-1, 1)) * self.random.randint(1, 3)
            path = [min(max(at + far * i, 0), steps - 1) for i in range(self.random.randint(3, 20))]
            await browser.drag(selection, path, rate=self.random.choice((3.0, 5.0)))
            self._count("dragged")
            await self._pause(0.3)
        what = self.random.random()
        where = trace_path(selection)[0].removeprefix("/api/trace")
        query = trace_path(selection)[1]
        if what < 0.3:
            name = self.random.choice(self.quick)
            await self._may(browser, "diagnosed", "GET", f"/api/diagnostics/{name}{where}", params=query)
        elif what < 0.4:
            body = {**selection, "maps": 50}
            await self._may(browser, "recorded", "POST", "/api/recordings", json=body)
        elif what < 0.44:
            name = self.random.choice(self.slow)
            await self._job(browser, f"/api/diagnostics/{name}{where}", query)
        elif what < 0.46:
            await self._job(browser, f"/api/reports{where}", query)
        elif what < 0.6:
            await self._may(browser, "listed", "GET", self.random.choice(("/", "/api/catalog", "/api/jobs")))

    async def _job(self, browser: Browser, path: str, query: dict[str, str]) -> None:
        job = (await self._may(browser, "submitted", "POST", path, params=query) or {}).get("job")
        if job and self.random.random() < 0.5:
            await self._pause(0.2)
            await self._may(browser, "cancelled", "DELETE", f"/api/jobs/{job['id']}")

    async def _may(self, browser: Browser, what: str, method: str, path: str, **more: Any) -> dict[str, Any] | None:
        """Asks for what may be refused (409: it does not apply; 404: forgotten meanwhile)."""
        answer = await browser.http.request(method, path, **more)
        if answer.status_code >= 500:
            raise RuntimeError(f"{method} {path}: {answer.status_code} {answer.text[:200]}")
        self._count(what if answer.status_code < 400 else "refused")
        kind = answer.headers.get("content-type", "")
        found = answer.json() if kind.startswith("application/json") else None
        return found if isinstance(found, dict) else None

    def _any(self) -> Selection:
        task = self.random.choice(self.catalog["tasks"])
        data = self.random.choice(task["data"])
        fault_sets = ["", *(faults["faults"] for faults in task["fault_presets"])]
        return {
            "task": task["name"],
            "filter": self.random.choice(task["filters"])["name"],
            "data": data["name"],
            "episode": self.random.choice(data["episodes"])["index"],
            "faults": self.random.choice(fault_sets),
        }

    async def _guarded(self, doing: Any) -> None:
        try:
            await doing
        except asyncio.CancelledError:
            raise
        except Exception as error:
            self.wrong.append(f"{type(error).__name__}: {error}")
            print(f"wrong: {self.wrong[-1]}", file=sys.stderr, flush=True)

    async def _pause(self, share: float = 1.0) -> None:
        await asyncio.sleep(share * self.rest * self.random.expovariate(1.0))

    def _count(self, what: str) -> None:
        self.done[what] = self.done.get(what, 0) + 1


def slope(hours: np.ndarray[Any, Any], values: np.ndarray[Any, Any]) -> tuple[float, float]:
    """Of a straight line, by hour, and half of its 95 % interval; blocks of time are taken for independent."""
    parts = [np.array_split(column, BLOCKS) for column in (hours, values)]
    x, y = ([float(np.mean(block)) for block in blocks] for blocks in parts)
    (rise, _), covariance = np.polyfit(x, y, 1, cov=True)
    return float(rise), 2.31 * float(np.sqrt(covariance[0, 0]))  # Student's t of BLOCKS - 2 degrees of freedom


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--browsers", type=int, default=4)
    parser.add_argument("--rest", type=float, default=8.0, help="mean s between two things that a hand does")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("soak.csv"))
    asked = parser.parse_args()
    with serving() as served:
        soak = Soak(served, asked.rest, asked.seed)
        rows = asyncio.run(soak.run(asked.browsers, asked.hours, asked.out))
        served.process.terminate()
        code = served.process.wait(30)
    settled = rows[rows[:, 0] >= WARM_UP * rows[-1, 0]]
    print(f"{asked.browsers} browsers, {rows[-1, 0]:.2f} h: {soak.done}; wrong: {len(soak.wrong)}; exit code {code}")
    for name, unit in (("memory_mb", "MB"), ("descriptors", ""), ("threads", ""), ("p95_ms", "ms")):
        column = COLUMNS.index(name)
        there = np.isfinite(settled[:, column])
        enough = there.sum() >= 3 * BLOCKS
        rise, width = slope(*settled[there][:, [0, column]].T) if enough else (np.nan, np.nan)
        first, last = settled[there][0, column], float(np.nanmedian(settled[-30:, column]))
        line = f"{rise:+.2f} ± {width:.2f} {unit} an hour"
        print(f"{name}: after the warm-up {first:.0f}, at last {last:.0f} {unit}; {line}")
    print(f"processor: {(rows[-1, 5] - rows[0, 5]) / (36 * (rows[-1, 0] - rows[0, 0])):.1f} % of a core")


if __name__ == "__main__":
    main()

"""Hours of use at a low rate: growth of the server's memory and descriptors.

    python tools/stress/soak.py --hours 2 --out soak.csv

A few simulated browsers select random filters, episodes and faults, scrub, rest, record, start and cancel jobs, and
close their connections or abort them. Every 10 s the server's resources are added to the CSV. At the end straight
lines are fitted to the samples after the warm-up.
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

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bench"))

import httpx
import numpy as np
from browsers import Browser, Selection, trace_path
from server_process import Served, serving

EVERY = 10.0  # s between samples
WARM_UP = 0.25  # fraction of the time
BLOCKS = 10
COLUMNS = ("hours", "memory_mb", "descriptors", "threads", "views", "cpu_s", "scrubs", "p50_ms", "p95_ms", "actions")


class Soak:
    """The browsers, their actions and errors.

    Args:
        rest: mean s between two actions.
    """

    def __init__(self, served: Served, rest: float, seed: int) -> None:
        self.served = served
        self.rest = rest
        self.random = random.Random(seed)
        self.actions: dict[str, int] = {}
        self.errors: list[str] = []
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
        tasks = [asyncio.create_task(self._browse()) for _ in range(browsers)]
        rows = []
        start = time.monotonic()
        try:
            with out.open("w", newline="") as file:
                writer = csv.writer(file)
                writer.writerow(COLUMNS)
                while (passed := time.monotonic() - start) < 3600 * hours:
                    rows.append(self._sample(passed / 3600))
                    writer.writerow([f"{value:.4g}" if isinstance(value, float) else value for value in rows[-1]])
                    file.flush()
                    await asyncio.sleep(EVERY)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        return np.array(rows, dtype=float)

    def _sample(self, hours: float) -> tuple[float, ...]:
        latencies = [t for browser in self.browsers for t in browser.scrubs]
        for browser in self.browsers:
            browser.scrubs.clear()
            browser.scenes.clear()
        p50, p95 = 1e3 * np.percentile(latencies, [50, 95]) if latencies else (np.nan, np.nan)
        served, actions = self.served, sum(self.actions.values())
        use = (served.memory, served.descriptors, served.threads, self.views, served.cpu)
        return (hours, *use, len(latencies), float(p50), float(p95), actions)

    async def _browse(self) -> None:
        """Open and close pages in one browser."""
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
                await self._inspect(browser)
                await self._pause()
        finally:
            vanish = self.random.random() < 0.3
            self._count("vanished" if vanish else "left")
            self.views -= 1
            await browser.close(vanish)

    async def _inspect(self, browser: Browser) -> None:
        selection = self._any()
        steps = await browser.load(selection)
        self._count("selected")
        for _ in range(self.random.randint(1, 4)):
            position = self.random.randrange(steps)
            stride = self.random.choice((-1, 1)) * self.random.randint(1, 3)
            path = [min(max(position + stride * i, 0), steps - 1) for i in range(self.random.randint(3, 20))]
            await browser.drag(selection, path, rate=self.random.choice((3.0, 5.0)))
            self._count("dragged")
            await self._pause(0.3)
        choice = self.random.random()
        route = trace_path(selection)[0].removeprefix("/api/trace")
        query = trace_path(selection)[1]
        if choice < 0.3:
            name = self.random.choice(self.quick)
            await self._request(browser, "diagnosed", "GET", f"/api/diagnostics/{name}{route}", params=query)
        elif choice < 0.4:
            body = {**selection, "maps": 50}
            await self._request(browser, "recorded", "POST", "/api/recordings", json=body)
        elif choice < 0.44:
            name = self.random.choice(self.slow)
            await self._job(browser, f"/api/diagnostics/{name}{route}", query)
        elif choice < 0.46:
            await self._job(browser, f"/api/reports{route}", query)
        elif choice < 0.6:
            await self._request(browser, "listed", "GET", self.random.choice(("/", "/api/catalog", "/api/jobs")))

    async def _job(self, browser: Browser, path: str, query: dict[str, str]) -> None:
        job = (await self._request(browser, "submitted", "POST", path, params=query) or {}).get("job")
        if job and self.random.random() < 0.5:
            await self._pause(0.2)
            await self._request(browser, "cancelled", "DELETE", f"/api/jobs/{job['id']}")

    async def _request(
        self, browser: Browser, action: str, method: str, path: str, **options: Any
    ) -> dict[str, Any] | None:
        """Send a request that may be refused (409: not applicable; 404: deleted)."""
        answer = await browser.http.request(method, path, **options)
        if answer.status_code >= 500:
            raise RuntimeError(f"{method} {path}: {answer.status_code} {answer.text[:200]}")
        self._count(action if answer.status_code < 400 else "refused")
        kind = answer.headers.get("content-type", "")
        document = answer.json() if kind.startswith("application/json") else None
        return document if isinstance(document, dict) else None

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

    async def _guarded(self, action: Any) -> None:
        try:
            await action
        except asyncio.CancelledError:
            raise
        except Exception as error:
            self.errors.append(f"{type(error).__name__}: {error}")
            print(f"error: {self.errors[-1]}", file=sys.stderr, flush=True)

    async def _pause(self, share: float = 1.0) -> None:
        await asyncio.sleep(share * self.rest * self.random.expovariate(1.0))

    def _count(self, action: str) -> None:
        self.actions[action] = self.actions.get(action, 0) + 1


def slope(hours: np.ndarray[Any, Any], values: np.ndarray[Any, Any]) -> tuple[float, float]:
    """Slope per hour, and half of its 95 % interval, assuming independent blocks of time."""
    parts = [np.array_split(column, BLOCKS) for column in (hours, values)]
    x, y = ([float(np.mean(block)) for block in blocks] for blocks in parts)
    (rise, _), covariance = np.polyfit(x, y, 1, cov=True)
    return float(rise), 2.31 * float(np.sqrt(covariance[0, 0]))  # Student's t of BLOCKS - 2 degrees of freedom


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--browsers", type=int, default=4)
    parser.add_argument("--rest", type=float, default=8.0, help="mean s between two actions")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("soak.csv"))
    args = parser.parse_args()
    with serving() as served:
        soak = Soak(served, args.rest, args.seed)
        rows = asyncio.run(soak.run(args.browsers, args.hours, args.out))
        served.process.terminate()
        code = served.process.wait(30)
    settled = rows[rows[:, 0] >= WARM_UP * rows[-1, 0]]
    print(
        f"{args.browsers} browsers, {rows[-1, 0]:.2f} h: {soak.actions}; errors: {len(soak.errors)}; exit code {code}"
    )
    for name, unit in (("memory_mb", "MB"), ("descriptors", ""), ("threads", ""), ("p95_ms", "ms")):
        column = COLUMNS.index(name)
        valid = np.isfinite(settled[:, column])
        enough = valid.sum() >= 3 * BLOCKS
        rise, width = slope(*settled[valid][:, [0, column]].T) if enough else (np.nan, np.nan)
        first, last = settled[valid][0, column], float(np.nanmedian(settled[-30:, column]))
        line = f"{rise:+.2f} ± {width:.2f} {unit} per hour"
        print(f"{name}: after the warm-up {first:.0f}, at the end {last:.0f} {unit}; {line}")
    print(f"CPU: {(rows[-1, 5] - rows[0, 5]) / (36 * (rows[-1, 0] - rows[0, 0])):.1f} % of a core")


if __name__ == "__main__":
    main()

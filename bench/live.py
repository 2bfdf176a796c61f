"""A live run on the page: how long from the moment a filter hands over a step until the page has drawn it.

A process of its own hands over steps of a door, at the rate of a robot and at twice that, to ``LiveRecorder``; headless
Chromium follows the newest step with time line, numbers, picture, maps and scene. Each delay ends when a frame with the
step has been drawn.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from page import browsing, found_chromium
from served import serving
from subject import Row

RATES = (10.0, 20.0)
SECONDS = 20.0

WRITER = """
import sys, time
import numpy as np
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.recordings.live import LiveRecorder

folder, rate, steps = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
with open_dataset(sample_path("door")) as data:
    episode = data[9]
belief, handed = np.diag([1e-4, 1e-4, 1e-3]), []
with LiveRecorder(f"at-{rate:.0f}", task="door", folder=folder, filter="bench") as live:
    began = time.monotonic()
    for t in range(steps):
        time.sleep(max(0.0, began + t / rate - time.monotonic()))
        i = t % len(episode)
        seen = {key: array[i] for key, array in episode.observations.items()}
        handed.append(time.time())
        truth = episode.states[i]
        live.step((truth + 0.01, belief), seen, episode.controls[i], truth=truth, qpos=episode.qpos[i])
np.save(f"{folder}/at-{rate:.0f}.npy", np.array(handed))
"""


def delays(handed: NDArray[np.float64], drawn: list[dict[str, float]]) -> NDArray[np.float64]:
    """(N,) ms from each step's handing over to the first frame that showed it or a later one, for steps since then."""
    shown, at = np.array([d["step"] for d in drawn]), np.array([d["at"] for d in drawn])
    steps = np.arange(int(shown[0]) + 1, int(shown[-1]) + 1)
    return at[np.searchsorted(shown, steps)] - 1e3 * handed[steps]


def measure() -> list[Row]:
    """A row for each rate."""
    if found_chromium() is None:
        return [("a live run on the page", "skipped: no Chromium on the path", "")]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as workspace, serving(workspace=Path(workspace)) as served, browsing() as page:
        folder = Path(workspace) / "live"
        for rate in RATES:
            steps = int(SECONDS * rate)
            writer = subprocess.Popen([sys.executable, "-c", WRITER, str(folder), str(rate), str(steps)])
            while not (folder / f"at-{rate:.0f}.live").exists():
                time.sleep(0.1)
            page.goto(f"{served.url}?task=door&data=live:at-{rate:.0f}")
            drawn: list[dict[str, float]] = []
            while writer.poll() is None:
                time.sleep(0.5)
                drawn = page.evaluate("() => window.beliefscope?.live.latencies ?? []") or drawn
            late = delays(np.load(folder / f"at-{rate:.0f}.npy"), drawn)
            middle, most = np.percentile(late, [50, 95])
            rows.append((f"step handed over to drawn, {rate:.0f} Hz: p50, p95", f"{middle:.0f}, {most:.0f} ms", ""))
    return rows

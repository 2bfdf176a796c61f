"""Latency of a live run on the page, from ``LiveRecorder.step`` to the drawn frame.

A separate process records steps of a door at the rate of a robot and at twice that; headless Chromium follows the
newest step with timeline, numbers, image, maps and scene.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from page import browsing, find_chromium
from server_process import serving
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
belief, times = np.diag([1e-4, 1e-4, 1e-3]), []
with LiveRecorder(f"at-{rate:.0f}", task="door", folder=folder, filter="bench") as live:
    start = time.monotonic()
    for t in range(steps):
        time.sleep(max(0.0, start + t / rate - time.monotonic()))
        i = t % len(episode)
        observations = {key: array[i] for key, array in episode.observations.items()}
        times.append(time.time())
        truth = episode.states[i]
        live.step((truth + 0.01, belief), observations, episode.controls[i], truth=truth, qpos=episode.qpos[i])
np.save(f"{folder}/at-{rate:.0f}.npy", np.array(times))
"""


def delays(step_times: NDArray[np.float64], frames: list[dict[str, float]]) -> NDArray[np.float64]:
    """(N,) ms from each recorded step to the first frame with this or a later step."""
    frame_steps, frame_times = np.array([f["step"] for f in frames]), np.array([f["at"] for f in frames])
    steps = np.arange(int(frame_steps[0]) + 1, int(frame_steps[-1]) + 1)
    return frame_times[np.searchsorted(frame_steps, steps)] - 1e3 * step_times[steps]


def measure() -> list[Row]:
    """Return one row per rate."""
    if find_chromium() is None:
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
            frames: list[dict[str, float]] = []
            while writer.poll() is None:
                time.sleep(0.5)
                frames = page.evaluate("() => window.beliefscope?.live.latencies ?? []") or frames
            latencies = delays(np.load(folder / f"at-{rate:.0f}.npy"), frames)
            p50, p95 = np.percentile(latencies, [50, 95])
            rows.append((f"recorded step to drawn frame, {rate:.0f} Hz: p50, p95", f"{p50:.0f}, {p95:.0f} ms", ""))
    return rows

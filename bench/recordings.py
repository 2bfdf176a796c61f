"""Recordings: writing speed, size, time to open, and memory of long live runs.

python bench/run.py recordings          writing speed and size
python bench/recordings.py --long       memory and bytes per step of live runs of 10^4 and 10^5 steps
python bench/recordings.py --open       time to open in the page's Rerun viewer, in Chromium
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from statistics import median

import subject
import torch
from page import browsing
from server_process import serving
from subject import NAMES, STEPS, Row

from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.trace import trace
from beliefscope.inspect.traces.run import start_run
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.write import write_recording

STRIDE = 4
MAPS = 400
"""Steps with maps in the speed measurement; the time includes the other steps of the recording."""

LONG = (10_000, 100_000)
REPEATS = 5


def measure() -> list[Row]:
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.rrd"
        for name in NAMES:
            traced = subject.traced(name)
            engine = MapEngine(subject.checkpoint(name), traced)
            write_recording(traced, path)
            duration = median(subject.seconds(lambda t=traced: write_recording(t, path)) for _ in range(5))
            used = median(cpu_seconds(lambda t=traced: write_recording(t, path)) for _ in range(5))
            size = path.stat().st_size
            figures = f"{STEPS / duration:.0f} steps/s, {STEPS / used:.0f} per CPU-s, {size / 1e6:.1f} MB"
            rows.append((f"{name}, without maps", figures, ">= 3000 steps/s"))
            maps = list(engine.maps(range(0, STEPS, STRIDE)))
            every = [replace(m, step=step) for step, m in zip(range(MAPS), cycle(maps), strict=False)]
            figures = f"{MAPS / subject.seconds(lambda t=traced, m=every: write_recording(t, path, m)):.0f} steps/s"
            rows.append(
                (f"{name}, {len(maps[0].layers)} maps of 135 x 135 per step, precomputed", figures, ">= 200 steps/s")
            )
            write_recording(traced, path, maps)
            size = path.stat().st_size
            rows.append((f"{name}, maps every {STRIDE} steps", f"{size / 1e6:.1f} MB", "<= 12 MB"))
    return rows


def cpu_seconds(function: Callable[[], object]) -> float:
    """CPU time of all threads of this process, s."""
    began = time.process_time()
    function()
    return time.process_time() - began


@torch.no_grad()
def live(name: str, steps: int, folder: Path) -> dict[str, float]:
    """A live run of the given number of steps, repeating 100 precomputed steps so that only recording is measured."""
    episode, checkpoint = subject.episode(), subject.checkpoint(name)
    run = start_run(checkpoint, episode, 0, 0, 300, subject.traced(name).faults)
    generator, filter_ = run.generator(), checkpoint.filter
    belief, precomputed = filter_.start(run.start, 300, generator), []
    for t in range(100):
        belief, step_trace = filter_.step(belief, run.evidence[t], generator)
        precomputed.append(
            (step_trace, {key: array[t] for key, array in episode.observations.items()}, run.evidence[t])
        )
    start = time.perf_counter()
    with LiveRecorder("long", checkpoint, folder=folder, start=run.start, like=episode, **run.provenance) as recorder:
        for t in range(steps):
            step_trace, observations, evidence = precomputed[t % 100]
            control, truth = episode.controls[t % 100], episode.states[t % 100]
            recorder.step(step_trace, observations, control, truth=truth, evidence=evidence)
        step_seconds = time.perf_counter() - start
    duration = time.perf_counter() - start
    return {
        "rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "live": recorder.path.stat().st_size / steps,
        "rrd": recorder.path.with_suffix(".rrd").stat().st_size / steps,
        "rate": steps / duration,
        "step_rate": steps / step_seconds,
        "waited": recorder.waited,
        "behind": recorder.behind,
    }


def long(names: tuple[str, ...] = NAMES) -> None:
    """Each run in a subprocess, for its own peak memory."""
    for name in names:
        for steps in LONG:
            with tempfile.TemporaryDirectory() as folder:
                command = [sys.executable, __file__, "--one", name, str(steps), folder]
                result = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
            print(
                f"{name}, {steps} steps: peak {result['rss_mb']:.0f} MB, {result['live']:.0f} B/step in the .live, "
                f"{result['rrd']:.0f} B/step in the recording; {result['step_rate']:.0f} steps/s accepted, "
                f"{result['rate']:.0f} steps/s written; {result['waited']:.0f} waits for the disk, "
                f"views at most {result['behind']:.0f} steps behind",
                flush=True,
            )


def measure_opening() -> None:
    """Print the time that the started viewer of the page takes to open 800-step recordings, and one of 2 steps."""
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder) / "recordings"
        files.mkdir()
        short = trace(subject.checkpoint(NAMES[0]), subject.episode().part(0, 2))
        paths = [write_recording(short, files / "2-steps.rrd")]
        for name in NAMES:
            traced = subject.traced(name)
            maps = MapEngine(subject.checkpoint(name), traced).maps(range(0, STEPS, STRIDE))
            paths.append(write_recording(traced, files / f"{name}.rrd", maps))
        with serving(workspace=Path(folder)) as served, browsing() as page:
            page.goto(f"{served.url}?data=sample&tab=rerun")
            page.wait_for_function("() => document.querySelector('#rerun')?.dataset.state === 'ready'", timeout=300_000)
            for path in paths:
                times = [page.evaluate(OPEN, f"/api/recordings/{path.name}?{number}") for number in range(REPEATS)]
                print(f"{path.stem}, {path.stat().st_size / 1e6:.1f} MB: open after {median(times):.2f} s")


OPEN = """async (url) => {
  const start = performance.now();
  beliefscope.rerun.files([{ name: 'run', url }]);
  do await new Promise(requestAnimationFrame);
  while (document.querySelector('#rerun').dataset.state === 'loading');
  if (document.querySelector('#rerun').dataset.state !== 'ready') throw new Error('the recording did not open');
  return (performance.now() - start) / 1000;
}"""
"""Seconds until the viewer has received and opened the file and drawn a frame."""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--open", action="store_true")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.one:
        print(json.dumps(live(args.one[0], int(args.one[1]), Path(args.one[2]))))
    elif args.long:
        long()
    elif args.open:
        measure_opening()
    else:
        parser.print_help()

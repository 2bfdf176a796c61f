"""Recordings: how fast they are written, how large they are, how soon they open, what a long live run costs.

python bench/run.py recordings          written fast enough, small enough
python bench/recordings.py --long       memory and bytes a step of live runs of 10^4 and 10^5 steps
python bench/recordings.py --open       from a click to the recording in the page's Rerun viewer, in Chromium
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from statistics import median

import subject
import torch
from page import browsing
from served import serving
from subject import NAMES, STEPS, Row

from beliefscope.inspect.likelihood import MapEngine
from beliefscope.inspect.trace import begin
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.write import write_recording

STRIDE = 4
MAPS = 400
"""Steps with maps where speed is measured. The others of that recording have none, but their time counts as well."""

LONG = (10_000, 100_000)


def measure() -> list[Row]:
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.rrd"
        for name in NAMES:
            traced = subject.traced(name)
            engine = MapEngine(subject.checkpoint(name), traced)
            write_recording(traced, path)
            took = median(subject.seconds(lambda t=traced: write_recording(t, path)) for _ in range(5))
            size = path.stat().st_size
            what = f"{STEPS / took:.0f} steps/s, {size / 1e6:.1f} MB, {size / STEPS:.0f} B/step"
            rows.append((f"{name}, without maps", what, ">= 2000 steps/s"))
            maps = list(engine.maps(range(0, STEPS, STRIDE)))
            every = [replace(one, step=step) for step, one in zip(range(MAPS), cycle(maps), strict=False)]
            what = f"{MAPS / subject.seconds(lambda t=traced, m=every: write_recording(t, path, m)):.0f} steps/s"
            rows.append(
                (f"{name}, {len(maps[0].layers)} maps of 135 x 135 a step, made before", what, ">= 200 steps/s")
            )
            write_recording(traced, path, maps)
            size = path.stat().st_size
            rows.append((f"{name}, maps every {STRIDE} steps", f"{size / 1e6:.1f} MB", "<= 15 MB"))
    return rows


@torch.no_grad()
def live(name: str, steps: int, folder: Path) -> dict[str, float]:
    """A live run of so many steps: the first 100 of the subject's over and over, so that only recording is measured."""
    episode, checkpoint = subject.episode(), subject.checkpoint(name)
    run = begin(checkpoint, episode, 0, 0, 300, subject.traced(name).faults)
    generator, filter_ = run.generator(), checkpoint.filter
    belief, taken = filter_.start(run.start, 300, generator), []
    for t in range(100):
        belief, known = filter_.step(belief, run.evidence[t], generator)
        taken.append((known, {key: array[t] for key, array in episode.observations.items()}, run.evidence[t]))
    began = time.perf_counter()
    with LiveRecorder("long", checkpoint, folder=folder, start=run.start, like=episode, **run.given) as recorder:
        for t in range(steps):
            known, seen, evidence = taken[t % 100]
            recorder.step(known, seen, episode.controls[t % 100], truth=episode.states[t % 100], evidence=evidence)
        stepped = time.perf_counter() - began
    took = time.perf_counter() - began
    return {
        "rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "live": recorder.path.stat().st_size / steps,
        "rrd": recorder.path.with_suffix(".rrd").stat().st_size / steps,
        "rate": steps / took,
        "step_rate": steps / stepped,
        "waited": recorder.waited,
        "behind": recorder.behind,
    }


def long(names: tuple[str, ...] = NAMES) -> None:
    """Each run in a process of its own: peak memory is a process's."""
    for name in names:
        for steps in LONG:
            with tempfile.TemporaryDirectory() as folder:
                command = [sys.executable, __file__, "--one", name, str(steps), folder]
                found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
            print(
                f"{name}, {steps} steps: peak {found['rss_mb']:.0f} MB, {found['live']:.0f} B/step in the .live file, "
                f"{found['rrd']:.0f} B/step in the recording; {found['step_rate']:.0f} steps/s taken, "
                f"{found['rate']:.0f} steps/s to the end; {found['waited']:.0f} waited for the disk, "
                f"views at most {found['behind']:.0f} steps behind",
                flush=True,
            )


def opened() -> None:
    """Prints how long the page's viewer, once started, takes to open an 800-step recording with maps."""
    name = "crossmodal-pf"
    traced = subject.traced(name)
    with tempfile.TemporaryDirectory() as folder, serving() as served, browsing() as page:
        path = Path(folder) / "run.rrd"
        write_recording(traced, path, MapEngine(subject.checkpoint(name), traced).maps(range(0, STEPS, STRIDE)))
        page.goto(f"{served.url}?data=sample&tab=rerun")
        page.wait_for_function("() => document.querySelector('#rerun')?.dataset.state === 'ready'", timeout=300_000)
        page.route("**/run.rrd*", lambda route: route.fulfill(path=path, content_type="application/octet-stream"))
        shown = ", ".join(f"{page.evaluate(OPEN, number):.2f}" for number in range(3))
        print(f"{name}, {STEPS} steps, maps every {STRIDE}, {path.stat().st_size / 1e6:.1f} MB: open after {shown} s")


OPEN = """async (number) => {
  const began = performance.now();
  beliefscope.rerun.files([{ name: 'run', url: `/run.rrd?${number}` }]);
  do await new Promise(requestAnimationFrame);
  while (document.querySelector('#rerun').dataset.state === 'loading');
  if (document.querySelector('#rerun').dataset.state !== 'ready') throw new Error('it does not open');
  return (performance.now() - began) / 1000;
}"""
"""s until the viewer has opened the file and drawn a frame."""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--open", action="store_true")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    if asked.one:
        print(json.dumps(live(asked.one[0], int(asked.one[1]), Path(asked.one[2]))))
    elif asked.long:
        long()
    elif asked.open:
        opened()
    else:
        parser.print_help()

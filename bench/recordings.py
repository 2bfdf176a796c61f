"""Size of an 800-step recording and the time to write it, with maps at several strides."""

from __future__ import annotations

import tempfile
from pathlib import Path

import subject
from subject import NAMES, STEPS, Row

from beliefscope.inspect.likelihood import MapEngine
from beliefscope.recordings.write import write_recording

STRIDES = (0, 8, 4)


def measure() -> list[Row]:
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.rrd"
        for name in NAMES:
            traced = subject.traced(name)
            engine = MapEngine(subject.checkpoint(name), traced)
            for stride in STRIDES:
                took = subject.seconds(
                    lambda s=stride, t=traced, e=engine: write_recording(
                        t, path, maps=e.maps(range(0, STEPS, s)) if s else None
                    )
                )
                size = path.stat().st_size
                what = f"{name}, " + (f"maps of 135 x 135 every {stride} steps" if stride else "without maps")
                figure = f"{size / 1e6:.1f} MB, {size / STEPS:.0f} B/step, {took:.1f} s"
                rows.append((what, figure, "<= 30 MB, <= 5 s"))
    return rows

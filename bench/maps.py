"""Full sets of likelihood maps (image, haptics, fused) a second, fine and coarse."""

from __future__ import annotations

import subject
from subject import NAMES, STEPS, Row

from beliefscope.inspect.likelihood import MapEngine

BARS = {135: 15, 41: 100}


def measure() -> list[Row]:
    rows: list[Row] = []
    for name in NAMES:
        engine = MapEngine(subject.checkpoint(name), subject.traced(name))
        for size, bar in BARS.items():
            steps = range(0, STEPS, 8 if size > 100 else 2)
            engine.map(0, size=size)
            took = subject.seconds(lambda s=steps, n=size, e=engine: [e.map(step, size=n) for step in s])
            rows.append((f"{name}, {size} x {size}", f"{len(steps) / took:.0f} sets/s", f">= {bar}"))
    return rows

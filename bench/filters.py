"""Steps a second of each filter, untraced and traced, and what tracing costs."""

from __future__ import annotations

import subject
from subject import NAMES, STEPS, Row

from beliefscope.filters.batch import Steps
from beliefscope.filters.evaluate import run
from beliefscope.inspect.trace import trace


def measure() -> list[Row]:
    rows: list[Row] = []
    for name in NAMES:
        checkpoint, episode = subject.checkpoint(name), subject.episode()
        batch = Steps.of(checkpoint.task, [episode]).episode(0)
        plain, traced, ratio = subject.in_turn(
            lambda c=checkpoint, b=batch: run(c.filter, b, 0.0, None, 300, 0),
            lambda c=checkpoint, e=episode: trace(c, e),
            turns=5,
        )
        rows += [
            (f"{name}, untraced", f"{STEPS / plain:.0f} steps/s", ""),
            (f"{name}, traced", f"{STEPS / traced:.0f} steps/s", ""),
            (f"{name}, traced / untraced", f"{ratio:.2f} x", "<= 1.3 x"),
        ]
    return rows

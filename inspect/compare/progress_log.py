"""Progress of a fine-tuning run as a file that another process reads."""

from __future__ import annotations

import json
import os
import time
from contextlib import suppress
from pathlib import Path

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.task import MainError
from beliefscope.filters.finetuning.loop import Validation
from beliefscope.filters.finetuning.report import error_summary
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.inspect.diagnostics.views import as_json

WRITE_INTERVAL = 0.3  # s between writes

COSTS = {"simulation": 4.0 / (os.cpu_count() or 1), "training": 0.5, "comparison": 2.4, "profile": 1.0}
"""Relative time of a step of an episode, from which the remaining time of a run is estimated. Measured with
``push-field information-ekf``; only the simulation runs on all cores."""


class ProgressLog:
    """Writes the loss of each step and all validations to a JSON file; continues that of an interrupted run."""

    def __init__(self, path: Path, steps: int, main: MainError) -> None:
        self._path, self._steps, self._main, self._written = path, steps, main, 0.0
        self._interrupted_losses = []
        with suppress(OSError, ValueError, KeyError):
            self._interrupted_losses = read_json(path.read_bytes())["losses"]
        self._losses: list[tuple[int, float]] = []
        self._validations: list[Validation] = []

    @property
    def errors(self) -> str:
        """Summary of the errors in the first and the last validation."""
        return error_summary(self._main, self._validations[0], self._validations[-1]) if self._validations else ""

    def resume(self, step: int) -> None:
        """Keep the losses up to this step of the interrupted run."""
        self._losses = [(at, loss) for at, loss in self._interrupted_losses if at <= step]

    def add_validation(self, validation: Validation) -> None:
        self._validations.append(validation)
        self.write()

    def add_step(self, step: int, loss: float) -> None:
        self._losses.append((step, loss))
        if time.monotonic() - self._written > WRITE_INTERVAL:
            self.write()

    def write(self) -> None:
        self._written = time.monotonic()
        document = {"steps": self._steps, "losses": self._losses, "validations": self._validations}
        write_atomically(self._path, json.dumps(as_json(document)).encode())


class ProgressShares:
    """Progress of a run, 0..1, from that of its parts, weighted with their estimated duration."""

    def __init__(self, settings: FineTune, data: Dataset, simulated: int) -> None:
        steps = len(data.held_out()) * max(summary.steps for summary in data.summaries)
        counts = {
            "simulation": simulated * max(summary.steps for summary in data.summaries),
            "training": settings.steps * settings.windows * settings.length,
            "comparison": steps,
            "profile": steps,
        }
        self._costs = {part: COSTS[part] * count for part, count in counts.items()}

    def __call__(self, part: str, done: float) -> float:
        """The progress of the run when a share of a part is done, and all parts before."""
        parts = list(self._costs)
        before = sum(self._costs[name] for name in parts[: parts.index(part)])
        return (before + self._costs[part] * done) / sum(self._costs.values())

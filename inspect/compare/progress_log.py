"""Progress of a fine-tuning run as a file that another process reads."""

from __future__ import annotations

import json
import time
from contextlib import suppress
from pathlib import Path

from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.task import MainError
from beliefscope.filters.finetuning.loop import Validation
from beliefscope.filters.finetuning.report import error_summary
from beliefscope.inspect.diagnostics.views import as_json

WRITE_INTERVAL = 0.3  # s between writes


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

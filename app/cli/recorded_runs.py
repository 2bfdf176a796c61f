"""Options of commands that take recorded runs in place of a task, with the filter that is needed for a task only."""

from __future__ import annotations

import os
from pathlib import Path

from beliefscope.app.cli import options as opt
from beliefscope.datasets.errors import BadInput

FORMS = "a recorded run (.trace, .live or .rrd)"


class TaskOrRecordedRuns(opt.Runs):
    """Options whose ``task`` may be the path of recorded runs, which need no ``filter``."""

    def __post_init__(self) -> None:
        """As ``Runs``; raises BadInput without a filter that runs over the episodes."""
        if not self.is_recorded:
            if not self.filter:
                raise self._missing_filter()
            super().__post_init__()

    def _missing_filter(self) -> BadInput:
        from beliefscope.datasets.catalog import TASKS
        from beliefscope.filters.names import RUNS

        if Path(self.task).is_dir():
            return BadInput(f"{self.task} has no recorded runs, files that end in {', '.join(RUNS)}")
        if os.sep in self.task and self.task not in TASKS and ":" not in self.task:
            return BadInput(f"{self.task} does not exist: expected a recorded run, a folder with some, or a task")
        return BadInput(f"--filter is missing: the filter that runs over the episodes of task {self.task}")

    @property
    def is_recorded(self) -> bool:
        from beliefscope.filters.names import is_run  # imports NumPy

        return self.data is None and is_run(self.task)

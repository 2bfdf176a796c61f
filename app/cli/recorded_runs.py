"""Options of commands that take recorded runs in place of a task, with the filter that is needed for a task only."""

from __future__ import annotations

from pathlib import Path

from beliefscope.app.cli import options as opt
from beliefscope.datasets.errors import BadInput

FORMS = "a recorded run (.trace, .live or .rrd)"


class TaskOrRecordedRuns(opt.Runs):
    """Options whose ``task`` may be the path of recorded runs, which need no ``filter``."""

    def __post_init__(self) -> None:
        """As ``Runs``; raises BadInput without a filter that runs over the episodes."""
        if not self.is_recorded:
            from beliefscope.filters.names import RUNS

            if not self.filter and Path(self.task).is_dir():
                raise BadInput(f"{self.task} has no recorded runs, files that end in {', '.join(RUNS)}")
            if not self.filter:
                raise BadInput(f"--filter is missing: the filter that runs over the episodes of task {self.task}")
            super().__post_init__()

    @property
    def is_recorded(self) -> bool:
        from beliefscope.filters.names import is_run  # imports NumPy

        return self.data is None and is_run(self.task)

"""The filter of a live run that the server does not have."""

from __future__ import annotations

from typing import Any

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.filters.external.load import ExternalFilter


class UnavailableFilter(ExternalFilter):
    """Stands for the filter of a live run that this server does not have. It can be drawn, but not run."""

    def __init__(self, name: str, hash_: str, task: Task) -> None:
        values = {"name": name, "record": {}, "hash": hash_, "source": name}
        for key, value in (values | {"_task": task}).items():
            object.__setattr__(self, key, value)  # checkpoints are frozen

    def run(self, *_: Any, **__: Any) -> Any:
        """Raises BadInput."""
        raise BadInput(f"this server has only a live run of filter {self.name!r}; add the filter with --filter")

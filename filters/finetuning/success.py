"""Success criterion of a fine-tuning run, set before the run.

As text, ``SLICE:measure=MEASURE:by=PERCENT:others=PERCENT``; everything but the slice is optional:
``contact:by=10%:others=5%``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.task import Task
from beliefscope.datasets.text import percent
from beliefscope.filters.finetuning.slices import Slice, fault_slices, standard_slices

ERROR = "error"
"""Measure of the task's main error."""

BELIEF = {"nll": "NLL", "nees": "NEES/n"}
"""Measures of the belief besides errors."""


@dataclass(frozen=True)
class Criterion:
    """A measure falls in one slice, and does not rise in the others.

    Attributes:
        slice: name of the slice that must improve. measure: ``error``, the name of a component, ``nll`` or ``nees``.
        by: share by which the measure must fall at least. others: share by which it may rise at most in any other
            slice. NLL and NEES count by the factor of errors or standard deviations to which they correspond
            (``inspect/statistics/episode_sums.py``).
    """

    slice: str
    measure: str = ERROR
    by: float = 0.1
    others: float = 0.05

    def __post_init__(self) -> None:
        """Raises BadInput for a share out of its range."""
        if not 0.0 < self.by < 1.0:
            raise BadInput(f"by={100.0 * self.by:.6g}% of a success criterion is not above 0 % and below 100 %")
        if not 0.0 <= self.others < math.inf:
            raise BadInput(f"others={100.0 * self.others:.6g}% of a success criterion is not 0 % or more")

    @classmethod
    def parse(cls, text: str) -> Criterion:
        """Reads a criterion. Raises BadInput for an unknown key or an invalid value."""
        name, *parts = (part.strip() for part in text.split(":"))
        values: dict[str, Any] = {}
        for part in parts:
            key, _, value = part.partition("=")
            if key not in ("measure", "by", "others") or key in values or not value:
                raise BadInput(
                    f"{part!r} in success criterion {text!r} is not one of measure=NAME, by=10%, others=5%, each once"
                )
            values[key] = value if key == "measure" else _share(value, part, text)
        if not name:
            raise BadInput(f"success criterion {text!r} has no slice; an example is contact:by=10%:others=5%")
        return cls(name, **values)

    def __str__(self) -> str:
        """The inverse of ``parse``."""
        measure = "" if self.measure == ERROR else f":measure={self.measure}"
        return f"{self.slice}{measure}:by={100.0 * self.by:.6g}%:others={100.0 * self.others:.6g}%"

    def check(self, task: Task, models: Sequence[str], trained: Iterable[Slice]) -> None:
        """Raises BadInput if the slice is neither standard nor trained on, or if the task lacks the measure."""
        names = list(dict.fromkeys(slice_.name for slice_ in (*trained, *criterion_slices(task, models))))
        if self.slice not in names:
            raise unknown_name("slice of the success criterion", self.slice, names)
        if self.measure not in measures(task):
            raise unknown_name("measure of the success criterion", self.measure, measures(task))

    def slices(self, task: Task, models: Sequence[str], trained: Sequence[Slice]) -> list[Slice]:
        """Slices to evaluate in addition to the standard ones: those trained on, and that of the criterion."""
        added = [s for s in fault_slices(task, models) if s.name == self.slice]
        return [*trained, *(s for s in added if s.name not in {other.name for other in trained})]

    def sentence(self, task: Task) -> str:
        """The criterion in words."""
        name = BELIEF.get(self.measure, f"{measures(task)[self.measure]} error")
        slice_ = self.slice.replace("_", " ")
        return (
            f"The {name} in slice \u201c{slice_}\u201d falls by at least {percent(self.by, '.6g')}, and in no other "
            f"slice rises by more than {percent(self.others, '.6g')}."
        )


def criterion_slices(task: Task, models: Sequence[str]) -> list[Slice]:
    """Slices that a criterion can name besides those trained on."""
    standard = [s for s in standard_slices(task) if not s.only or (len(models) > 1 and set(s.only) <= set(models))]
    return [*standard, *fault_slices(task, models)]


def measures(task: Task) -> dict[str, str]:
    """Measures that a criterion can have: name -> name of the quantity."""
    components = {c.name: c.name.replace("_", " ") for i, c in enumerate(task.components) if not _is_main(task, i)}
    return {ERROR: task.main_error.name, **components, **BELIEF}


def _is_main(task: Task, index: int) -> bool:
    return task.main_error.indices == (index,)


def _share(value: str, part: str, text: str) -> float:
    try:
        return float(value.removesuffix("%").strip()) / 100.0
    except ValueError:
        raise BadInput(f"{part!r} in success criterion {text!r} is not a percentage such as by=10%") from None

"""Offset starts: a first belief beside the true state, with a covariance that matches the offset."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode, FloatArray
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import DISPLAY_UNITS, Task, display_unit
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.filter import Filter
from beliefscope.filters.rollout import first_belief

NUMBER = re.compile(r"[-+\d.]*(e[-+]?\d+)?")
"""The start of an offset."""


@dataclass(frozen=True)
class StartOffset:
    """Distance of the first belief's mean from the true state, in a random direction.

    Attributes:
        lengths: internal unit -> length in it: ``{"m": 0.03, "rad": 0.35}``. The components of one unit form a vector
            of this length and of uniform direction; the sign of a single component is random. Components of other units
            start at the truth.
    """

    lengths: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str, task: Task) -> StartOffset:
        """From text such as ``3cm,20deg``. Raises BadInput for other text and for units that the task does not have."""
        units = {c.conversion[0]: (c.unit, c.conversion[1]) for c in task.components}
        units |= {c.unit: (c.unit, 1.0) for c in task.components if c.unit not in units and c.unit not in DISPLAY_UNITS}
        lengths: dict[str, float] = {}
        for part in filter(None, (part.strip() for part in text.split(","))):
            number = NUMBER.match(part)[0]  # type: ignore[index]  # matches any text
            suffix = part[len(number) :].strip()
            if suffix not in units:
                raise BadInput(f"start offset {part!r} is not in a unit of task {task.name!r}: {', '.join(units)}")
            try:
                value = float(number)
            except ValueError:
                value = math.nan
            unit, factor = units[suffix]
            if not 0.0 < value < 1e6 or unit in lengths:
                raise BadInput(f"start offset {part!r} of {text!r} is not one positive length, such as 3{suffix}")
            if task.rotations and unit == "rad":
                name = task.components[task.rotations[0].start].rotation
                raise BadInput(f"start offset {part!r}: {name!r} is a rotation, which starts at the truth")
            lengths[unit] = value / factor
        return cls(lengths)

    def for_task(self, task: Task) -> StartOffset:
        """The same offset without the units that the task does not have."""
        return StartOffset(
            {unit: self.lengths[unit] for unit in self.lengths if unit in {c.unit for c in task.components}}
        )

    def __bool__(self) -> bool:
        return bool(self.lengths)

    def __str__(self) -> str:
        displayed = {unit: display_unit(unit) for unit in self.lengths}
        return ",".join(f"{factor * self.lengths[unit]:g}{name}" for unit, (name, factor) in displayed.items())

    def vectors(self, task: Task, episodes: Sequence[Episode], seed: int) -> FloatArray:
        """(N, n) offsets in SI units. Directions depend only on the seed and on each episode's digest."""
        offsets = np.zeros((len(episodes), len(task.components)))
        for row, episode in zip(offsets, episodes, strict=True):
            rng = np.random.default_rng([seed, int(episode.digest()[:16], 16)])
            for unit, length in sorted(self.lengths.items()):
                members = [i for i, component in enumerate(task.components) if component.unit == unit]
                direction = rng.standard_normal(len(members))
                row[members] = length * direction / np.linalg.norm(direction)
        return offsets.astype(np.float32)

    def variances(self, task: Task) -> FloatArray:
        """(n,) mean square of each component's offset, SI units; NaN without offset."""
        distances = {unit: (length, length) for unit, length in self.lengths.items()}
        return replace(task, start_distance=distances).start_variance().astype(np.float32)


NO_OFFSET = StartOffset()
"""Start as the task does."""

STUDY_OFFSET = StartOffset({"m": 0.03, "rad": math.radians(20.0)})
"""Offset of studies. A start at the truth hides how well a filter finds a state that does not move."""


def shifted(start: Gaussian, offsets: Tensor, variances: Tensor) -> Gaussian:
    """The start (N, n), (N, n, n) with offsets (N, n) and variances (n,) of its covariance; NaN keeps the variance."""
    diagonal = torch.where(variances.isnan(), start.covariance.diagonal(dim1=-2, dim2=-1), variances)
    return Gaussian(start.mean + offsets, torch.diag_embed(diagonal))


def offset_start(filter_: Filter, batch: Batch, offsets: Tensor, variances: Tensor) -> Gaussian:
    """The first belief, standardised: ``first_belief`` with offsets (N, n) and variances (n,) in SI units."""
    _, std = filter_.statistics.mean_std("state")
    return shifted(first_belief(filter_, batch), offsets / std, variances / std.square())


def without_start_offset(episode: Episode) -> Episode:
    """The episode with its first belief at the true state."""
    provenance = {key: value for key, value in episode.provenance.items() if key != "start_offset"}
    return replace(episode, provenance=provenance)

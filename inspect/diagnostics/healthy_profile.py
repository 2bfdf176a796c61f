"""Healthy profile: episode statistics of a checkpoint on clean held-out episodes, which its later runs should match.

New checkpoints have it in their header; pretrained ones have a file beside them, which keeps their hash. What is the
same for all pretrained filters of a task, such as statistics of its sensors, is in a file of the task.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.names import PRETRAINED
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.reference_images import Reference
from beliefscope.inspect.statistics.signals import Array

FORMAT = 4
"""Of earlier ones, 1 has no reference and no statistics of sensors and modules; 2 and 3 have other ``MEASURED_ANEW``,
3 other slopes of the dynamics."""

MEASURED_ANEW = (
    "dynamics ",
    "process noise/",
    "measurement jacobian/",
    "prediction jacobian/",
    "correction slope/",
    "offspring/",
)
"""Statistics of external filters that have changed: most were of the run, and are of single steps from true states."""

SUFFIX = ".profile.json"
"""Of the file beside a pretrained checkpoint."""
SENSORS_SUFFIX = ".sensors.json"
"""Of the file of a task: ``statistics`` and ``reference`` of the profiles of all its pretrained filters."""

DIGITS = 3
"""Significant digits of stored values, whose rounding is small against the differences between episodes."""


@dataclass(frozen=True)
class HealthyProfile:
    """Values of E clean held-out episodes.

    Attributes:
        data: where the episodes come from: a command or the name of a data set.
        episodes: E.
        particles: number of particles, or None.
        statistics: ``KIND/SUBJECT/PHASE`` -> (E,) values by episode, SI units; NaN where there is none, such as
            in a phase of too few steps.
        reference: healthy images; None in records of format 1 and for tasks without images.
        readings: models of the vector sensors of unknown physics; none in records of earlier versions.
        steps: smallest and largest number of steps of the episodes; None in records of earlier versions.
        task: name of the task; empty in records of earlier versions.
    """

    data: str
    episodes: int
    particles: int | None
    statistics: Mapping[str, Array]
    reference: Reference | None = None
    readings: tuple[ReadingModel, ...] = ()
    steps: tuple[int, int] | None = None
    task: str = ""

    def to_json(self) -> dict[str, Any]:
        """JSON values, rounded to ``DIGITS``; NaN as null."""
        rows = {
            name: [None if np.isnan(value) else float(f"{value:.{DIGITS}g}") for value in values.tolist()]
            for name, values in self.statistics.items()
        }
        head = {"format": FORMAT, "data": self.data, "episodes": self.episodes, "particles": self.particles}
        reference = None if self.reference is None else self.reference.to_json()
        models = {"readings": [model.to_json() for model in self.readings]} if self.readings else {}
        steps = {"steps": list(self.steps)} if self.steps else {}
        head |= {"task": self.task} if self.task else {}
        return {**head, **steps, "statistics": rows, "reference": reference, **models}

    @classmethod
    def from_json(cls, document: Any) -> HealthyProfile:
        """Inverse of ``to_json``. Raises BadInput for another format or malformed values."""
        try:
            if document["format"] not in range(1, FORMAT + 1):
                raise BadInput(f"healthy record of format {document['format']!r}; this version reads 1 to {FORMAT}")
            count, particles = int(document["episodes"]), document["particles"]
            rows = {
                str(name): np.array([np.nan if value is None else value for value in values], dtype=np.float64)
                for name, values in document["statistics"].items()
            }
            data, images = str(document["data"]), document.get("reference")
            reference = None if images is None else Reference.from_json(images)
            # Other models are of an earlier version, with other features.
            models = (model for model in document.get("readings", ()) if "of_channels" in model)
            readings = tuple(map(ReadingModel.from_json, models))
            steps = document.get("steps")
            lengths = None if steps is None else (int(steps[0]), int(steps[1]))
            task = str(document.get("task", ""))
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise BadInput(f"the healthy record is malformed: {error!r}") from None
        for name, values in rows.items():
            if values.shape != (count,) or name.count("/") != 2:
                raise BadInput(f"the healthy record is malformed: {name!r} has {len(values)} values of {count}")
        particles = None if particles is None else int(particles)
        return cls(data, count, particles, rows, reference, readings, lengths, task)


def find_profile(task: str, filter_: str, checkpoint_hash: str, checkpoint: Checkpoint | None) -> HealthyProfile | None:
    """Profile of a checkpoint, or None; see ``profile_document``. Raises BadInput if it is malformed."""
    document = profile_document(task, filter_, checkpoint_hash, checkpoint)
    if document is None:
        return None
    profile = HealthyProfile.from_json(document)
    if document["format"] == FORMAT or not isinstance(checkpoint, ExternalFilter):
        return profile
    kept = {name: v for name, v in profile.statistics.items() if not name.startswith(MEASURED_ANEW)}
    return replace(profile, statistics=kept)


def profile_document(task: str, filter_: str, checkpoint_hash: str, checkpoint: Checkpoint | None) -> Any:
    """JSON of a profile: beside the pretrained checkpoint of this hash, else in its header; None without either.

    The file beside a pretrained checkpoint is measured again when statistics are added, its header is not.
    """
    document = _file_beside_pretrained(task, filter_)
    beside = document["healthy_profile"] if document and document["checkpoint"] == checkpoint_hash else None
    return beside or (checkpoint.healthy_profile if checkpoint is not None else None)


def pretrained_reference(task: Task) -> Reference | None:
    """Healthy images of a task with pretrained filters; None without any."""
    image = _sensors_of_pretrained(task.name)["reference"]
    return None if image is None else Reference.from_json(image)


@lru_cache(maxsize=4)  # files of pretrained filters do not change; reading one takes 2 ms
def _file_beside_pretrained(task: str, filter_: str) -> dict[str, Any] | None:
    name = f"{task}-{filter_}{SUFFIX}"
    path = next((path for path in PRETRAINED.iterdir() if path.name == name), None)  # the name may be a path
    if path is None:
        return None
    document, sensors = json.loads(path.read_text()), _sensors_of_pretrained(task)
    profile = document["healthy_profile"]
    profile |= {"statistics": profile["statistics"] | sensors["statistics"], "reference": sensors["reference"]}
    return document


@lru_cache(maxsize=4)
def _sensors_of_pretrained(task: str) -> dict[str, Any]:
    path = PRETRAINED / (task + SENSORS_SUFFIX)
    return json.loads(path.read_text()) if path.is_file() else {"statistics": {}, "reference": None}

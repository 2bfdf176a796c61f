"""The catalog of causes. To add one, write a file in ``causes/`` and list it here."""

from __future__ import annotations

from beliefscope.datasets.task import Task
from beliefscope.inspect.diagnosis.cause import Cause
from beliefscope.inspect.diagnosis.causes import (
    data,
    dynamics,
    force,
    fusion,
    image,
    model,
    other_sensors,
    own_sensors,
    particles,
)

CAUSES: tuple[Cause, ...] = (
    *image.CAUSES,
    *force.CAUSES,
    *other_sensors.CAUSES,
    *data.CAUSES,
    *model.CAUSES,
    *dynamics.CAUSES,
    *fusion.CAUSES,
    *particles.CAUSES,
)
"""All causes, by component."""


def causes_of(task: Task) -> tuple[Cause, ...]:
    """All causes, and those in sensors that only this task has."""
    return (*CAUSES, *own_sensors.own_causes(task))

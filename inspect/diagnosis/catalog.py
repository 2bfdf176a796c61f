"""The catalog of causes. To add one, write a file in ``causes/`` and list it here."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause
from beliefscope.inspect.diagnosis.causes import (
    data,
    dynamics,
    force,
    fusion,
    image,
    model,
    other_sensors,
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

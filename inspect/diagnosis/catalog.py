"""The catalog of causes. To add one, write a file in ``causes/`` and list it here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.diagnosis.cause import Cause
from beliefscope.inspect.diagnosis.causes import (
    data,
    dynamics,
    force,
    fusion,
    image,
    model,
    other_sensors,
    own_models,
    own_sensors,
    particles,
)
from beliefscope.inspect.diagnosis.causes.consequences import model_of
from beliefscope.inspect.diagnosis.causes.external_filters import external_causes, in_predictions
from beliefscope.inspect.diagnosis.causes.recorded import OF_ESTIMATES, RECORDED
from beliefscope.inspect.diagnosis.checks.true_starts import has_true_starts
from beliefscope.inspect.statistics.reference_images import HAND

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


SENSORS = {"image": "image", "force": "force", "torque": "torque", "contact": "contact", "effector": HAND}
"""Component of a cause -> observation key of its sensor."""


def causes_of(task: Task) -> tuple[Cause, ...]:
    """All causes, and those in sensors that only this task has."""
    modalities = {key: modality for modality, keys in task.modalities.items() for key in keys}
    own = own_sensors.sensor_causes(task) + own_models.model_causes(task)
    names = {cause.name for cause in own}
    return (*(_of_modality(cause, modalities) for cause in CAUSES if cause.name not in names), *own)


def causes_in(checkpoint: Checkpoint, estimates_only: bool = False) -> tuple[Cause, ...]:
    """All causes of a filter: those of its task, and those of external filters only.

    estimates_only: whether an external filter reports nothing else, so that its equations are unknown.
    """
    causes = causes_of(checkpoint.task)
    if isinstance(checkpoint, UnavailableFilter):
        causes = (*causes, *RECORDED)
    elif estimates_only:
        causes = (*causes, *OF_ESTIMATES)
    if isinstance(checkpoint, ExternalFilter):
        starts, task = has_true_starts(checkpoint), checkpoint.task
        groups = [*task.modalities.items(), *((key, (key,)) for key in task.observations)]
        # Labels differ from a moved camera by the models of the other modalities.
        inputs = {name for name, keys in groups if not {*keys} & {*task.images}} | {"labels"}
        images = {key: name for name, keys in task.modalities.items() for key in keys if key in task.images}
        return tuple(in_predictions(cause, starts, inputs, images) for cause in (*causes, *external_causes(task)))
    return causes


def _of_modality(cause: Cause, modalities: Mapping[str, str]) -> Cause:
    """A cause in a sensor, with the modality that has the sensor in a task. modalities: by observation key."""
    component = cause.name.partition(".")[0]
    written = "image" if component == "image" else "haptics"  # the modality that the catalog writes
    modality = modalities.get(SENSORS.get(component, ""), written)
    if modality == written:
        return cause
    undo = "|".join(f"drop {modality}" if name == f"drop {written}" else name for name in cause.undo.split("|"))
    consequences = cause.consequences.replace(model_of(written), model_of(modality))
    return replace(cause, undo=undo, consequences=consequences)

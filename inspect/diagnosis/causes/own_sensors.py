"""Causes in sensors of a user's task, by the names of its observations."""

from __future__ import annotations

from beliefscope.datasets.task import Task, display_name
from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import LABELS, WEIGHTS
from beliefscope.inspect.diagnosis.vector_checks import FORCE, TORQUE, has_labels_only
from beliefscope.inspect.statistics.reference_images import HAND

KNOWN = ("image", "force", "torque", "effector_position", "contact")
"""Observations that have their own causes."""

VECTOR = (
    ("stuck", "stuck", "stuck", "Restart the sensor and check its connection."),
    ("noise", "noise", "noisy", "Check the cable and the filter of the sensor."),
    ("saturation", "saturation", "saturated", "Extend the measuring range of the sensor."),
)
"""Kinds of the statistic, mechanism, word of the title, next action."""

IMAGE = (
    ("black|losses", "blackout", "blacked out", "Check the camera and its driver."),
    ("frozen", "frozen", "frozen", "Check the camera and its driver."),
    ("noise", "noise", "noisy", "Light the scene better, or correct the exposure and gain of the camera."),
)
"""As ``VECTOR``, of images."""


def own_causes(task: Task) -> tuple[Cause, ...]:
    """Causes in the sensors of a task that have none in the catalog."""
    keys = {key: modality for modality, keys in task.modalities.items() for key in keys if key not in KNOWN}
    result = []
    for key, modality in keys.items():
        changed = f"*/{key}/*|*/{key} */*|lag/*|module */*{modality}*|likelihood share/*|{LABELS}|{WEIGHTS}"
        for kinds, mechanism, word, action in IMAGE if key in task.images else VECTOR:
            symptom = Symptom("|".join(f"{kind}/{key}/*|{kind}/{key} */*" for kind in kinds.split("|")))
            title = f"Sensor {display_name(key)} {word}"
            result.append(Cause(f"{key}.{mechanism}", title, (symptom,), changed, action, f"drop {modality}"))
    return (*result, *_delays(task))


def _delays(task: Task) -> tuple[Cause, ...]:
    """Delays of vector sensors behind the labelled contact, of tasks without a contact sensor.

    Force and torque are of one sensor: a delay of the force explains that of the torque, and the laws of both.
    """
    result = []
    for modality, keys in task.modalities.items() if has_labels_only(task) else ():
        for key in (key for key in keys if len(task.observations[key]) == 1 and key != HAND):
            changed = f"*/{key}/*|*/{key} */*|lag/*|module */*{modality}*|likelihood share/*|{LABELS}|{WEIGHTS}"
            if key in (FORCE, TORQUE):
                changed += f"|lever/{FORCE}*|axes/{FORCE}/*|size/*/contact"
            if key == FORCE and TORQUE in task.observations:
                changed += f"|*/{TORQUE}/*|*/{TORQUE} */*"
            title, action = f"Sensor {display_name(key)} delayed", "Synchronise the clocks of the sensors."
            symptoms = (Symptom(f"contact lag/{key}/*"),)
            result.append(Cause(f"{key}.delay", title, symptoms, changed, action, f"advance {key}"))
    return tuple(result)

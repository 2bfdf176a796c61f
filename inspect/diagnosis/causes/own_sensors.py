"""Causes in sensors and measurement models of a user's task, by the names of its observations and modalities."""

from __future__ import annotations

from beliefscope.datasets.task import Task, display_name
from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes import model
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, LABELS, WEIGHTS
from beliefscope.inspect.diagnosis.causes.image import OBJECT
from beliefscope.inspect.diagnosis.vector_checks import FORCE, TORQUE, commands_hand, has_labels_only
from beliefscope.inspect.statistics.reference_images import HAND

KNOWN = ("image", "force", "torque", "effector_position", "contact")
"""Observations that have their own causes."""

MODALITIES = ("image", "haptics")
"""Modalities whose measurement models have causes in the catalog."""

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


CONTROLS = (
    Cause(
        "control.scale",
        "Controls scaled",
        (Symptom("size/control*", 0), Symptom("dynamics slope/*|dynamics spread/*", 0, optional=True)),
        f"{DYNAMICS}|{LABELS}",
        "Check the units of the controls.",
        "scale control",
    ),
    Cause(
        "control.delay",
        "Controls delayed",
        (Symptom("lag/dynamics/*", -1),),
        f"{DYNAMICS}|{LABELS}",
        "Synchronise the controls with the sensors.",
        "advance control",
    ),
    Cause(
        "control.sign",
        "Controls with the opposite sign",
        (Symptom("opposed/control*"),),
        f"lag/dynamics/*|{DYNAMICS}|{LABELS}",
        "Check the sign convention of the controls.",
        "negate control",
    ),
)
"""Causes in controls that do not command a measured hand, as the dynamics model of the filter shows them."""


def own_causes(task: Task) -> tuple[Cause, ...]:
    """Causes in the sensors of a task that have none in the catalog."""
    keys = {key: modality for modality, keys in task.modalities.items() for key in keys if key not in KNOWN}
    result = []
    for key, modality in keys.items():
        changed = f"*/{key}/*|*/{key} */*|lag/*|{_downstream(modality)}"
        for kinds, mechanism, word, action in IMAGE if key in task.images else VECTOR:
            symptom = Symptom("|".join(f"{kind}/{key}/*|{kind}/{key} */*" for kind in kinds.split("|")))
            title = f"Sensor {display_name(key)} {word}"
            result.append(Cause(f"{key}.{mechanism}", title, (symptom,), changed, action, f"drop {modality}"))
    controls = CONTROLS if task.control_size and not commands_hand(task) else ()
    return (*result, *_moved_cameras(task), *_delays(task), *_delayed_modalities(task), *_models(task), *controls)


def _downstream(modality: str) -> str:
    """Statistics that a fault in a sensor of a modality changes downstream."""
    return f"module */*{modality}*|likelihood share/*|{LABELS}|{WEIGHTS}"


def _moved_cameras(task: Task) -> tuple[Cause, ...]:
    """Cameras of tasks without a measured hand, whose position only the labels show: labels with an offset are alike.

    A second sensor of the position separates the two: it agrees with the labels if the camera has moved.
    """
    result = []
    for modality, keys in task.modalities.items() if HAND not in task.observations else ():
        for key in (key for key in keys if key in task.images):
            changed = f"object match/*|occlusion/{key}/*|brightness/{key}/*|sharpness/{key}/*|{_downstream(modality)}"
            title = "Camera moved" if key == "image" else f"Camera {display_name(key)} moved"
            symptoms = (
                Symptom(OBJECT, 0),
                Symptom(f"module bias/*{modality}*", 0, 0.5),
                Symptom("module bias/*", 0, 0.3, "alone"),
            )
            undo = f"realign image|drop {modality}" if key == "image" else f"drop {modality}"
            result.append(Cause(f"{key}.shift", title, symptoms, changed, "Calibrate the camera pose again.", undo))
    return tuple(result)


def _delayed_modalities(task: Task) -> tuple[Cause, ...]:
    """Modalities behind the labels, of tasks without a measured hand and labelled contact, which show it better."""
    result = []
    for modality in task.modalities if HAND not in task.observations and not has_labels_only(task) else ():
        changed = f"{OBJECT}|object match/*|{_downstream(modality)}"
        title = "Image delayed" if modality == "image" else f"Modality {display_name(modality)} delayed"
        symptoms, action = (Symptom(f"lag/labels {modality}/*", -1),), "Synchronise the clocks of the sensors."
        result.append(Cause(f"{modality}.delay", title, symptoms, changed, action, f"advance {modality}"))
    return tuple(result)


def _models(task: Task) -> tuple[Cause, ...]:
    """Causes in measurement models of modalities that the catalog does not have."""
    check = "Check the calibration of its sensors, whose offsets and scales have the same symptoms. "
    names = [name for name in task.modalities if name not in MODALITIES]
    return tuple(c for name in names for c in model.causes_of(name, f"Sensors or model of {display_name(name)}", check))


def _delays(task: Task) -> tuple[Cause, ...]:
    """Delays of vector sensors behind the labelled contact, of tasks without a contact sensor.

    Force and torque are of one sensor: a delay of the force explains that of the torque, and the laws of both.
    """
    result = []
    for modality, keys in task.modalities.items() if has_labels_only(task) else ():
        for key in (key for key in keys if len(task.observations[key]) == 1 and key != HAND):
            changed = f"*/{key}/*|*/{key} */*|lag/*|{_downstream(modality)}"
            if key in (FORCE, TORQUE):
                changed += f"|lever/{FORCE}*|axes/{FORCE}/*|size/*/contact"
            if key == FORCE and TORQUE in task.observations:
                changed += f"|*/{TORQUE}/*|*/{TORQUE} */*"
            title, action = f"Sensor {display_name(key)} delayed", "Synchronise the clocks of the sensors."
            symptoms = (Symptom(f"contact lag/{key}/*"),)
            result.append(Cause(f"{key}.delay", title, symptoms, changed, action, f"advance {key}"))
    return tuple(result)

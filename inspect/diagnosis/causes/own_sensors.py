"""Causes in sensors and measurement models of a user's task, by the names of its observations and modalities."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from beliefscope.datasets.task import Task, display_name
from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes import data, fusion, image, model
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, FILTER, LABELS, WEIGHTS
from beliefscope.inspect.diagnosis.causes.image import OBJECT
from beliefscope.inspect.diagnosis.vector_checks import FORCE, TORQUE, commands_hand, has_labels_only
from beliefscope.inspect.statistics.reference_images import HAND

KNOWN = ("image", "force", "torque", "effector_position", "contact")
"""Observations that have their own causes."""

MODALITIES = ("image", "haptics")
"""Modalities whose measurement models have causes in the catalog."""

BIASED = ("level", "drift", "saturation", "contact lag")
"""Kinds of statistics of vector sensors that a bias changes."""

VECTOR = (
    ("stuck", "stuck", "stuck", "Restart the sensor and check its connection."),
    ("saturation", "saturation", "saturated", "Extend the measuring range of the sensor."),
)
"""Kinds of the statistic, mechanism, word of the title, next action."""

IMAGE = (
    ("black|losses", "blackout", "blacked out", "Check the camera and its driver."),
    ("frozen", "frozen", "frozen", "Check the camera and its driver."),
    ("noise", "noise", "noisy", "Light the scene better, or correct the exposure and gain of the camera."),
)
"""As ``VECTOR``, of images."""

VIEW = {
    "blur": "Images of {} blurred",
    "exposure": "Exposure of {} changed",
    "occlusion": "Camera {} occluded",
}
"""Mechanisms of causes in the image that other cameras have as well -> title."""


def own_causes(task: Task) -> tuple[Cause, ...]:
    """Causes in the sensors of a task that have none in the catalog."""
    keys = {key: modality for modality, keys in task.modalities.items() for key in keys if key not in KNOWN}
    result = []
    for key, modality in keys.items():
        changed = f"*/{key}/*|*/{key} */*|lag/*|{_downstream(modality)}"
        for kinds, mechanism, word, action in IMAGE if key in task.images else VECTOR:
            symptom = Symptom(_patterns(key, *kinds.split("|")))
            title = f"Sensor {display_name(key)} {word}"
            result.append(Cause(f"{key}.{mechanism}", title, (symptom,), changed, action, f"drop {modality}"))
        result += _changed_readings(key, modality) if len(task.observations[key]) == 1 else []
        result += _changed_views(key, modality) if key in task.images else []
    parts = (_moved_cameras, _delays, _delayed_modalities, _models, _labels, _controls, _weights)
    return (*result, *(cause for part in parts for cause in part(task)))


def _patterns(key: str, *kinds: str) -> str:
    """Patterns of the statistics of these kinds about a sensor or one of its axes."""
    return "|".join(f"{kind}/{key}/*|{kind}/{key} */*" for kind in kinds)


def _changed_readings(key: str, modality: str) -> list[Cause]:
    """Noise, bias and gain of a vector sensor. A gain changes size and noise alike, noise their ratio."""
    of = partial(_patterns, key)
    scaled = of(*BIASED, "change", "size", "noise")
    noise = (Symptom(of("noise")), Symptom(of("roughness"), optional=True))
    gain = (Symptom(of("size"), 0), Symptom(of("noise"), 0))
    rough = f"{scaled}|{of('roughness', 'stuck')}"
    entries = (
        ("noise", "noisy", noise, rough, "Check the cable and the filter of the sensor."),
        ("bias", "biased", (Symptom(of("level"), 0),), of(*BIASED), "Tare the sensor."),
        ("gain", "has a wrong gain", gain, scaled, "Check the unit and the gain of the sensor."),
    )
    return [
        Cause(
            f"{key}.{mechanism}",
            f"Sensor {display_name(key)} {words}",
            symptoms,
            f"{changed}|{_downstream(modality)}",
            action,
            f"drop {modality}",
        )
        for mechanism, words, symptoms, changed, action in entries
    ]


def _changed_views(key: str, modality: str) -> list[Cause]:
    """Causes of ``VIEW`` with the names of the sensor and its modality.

    The edges of an object in front of the camera change the sharpness as well.
    """

    def renamed(patterns: str) -> str:
        return patterns.replace("/image", f"/{key}").replace("*image*", f"*{modality}*")

    return [
        replace(
            cause,
            name=f"{key}.{mechanism}",
            title=VIEW[mechanism].format(display_name(key)),
            symptoms=tuple(replace(symptom, statistics=renamed(symptom.statistics)) for symptom in cause.symptoms),
            consequences=renamed(cause.consequences) + (f"|sharpness/{key}/*" if mechanism == "occlusion" else ""),
            lowers=renamed(cause.lowers),
            undo=f"drop {modality}",
        )
        for cause in image.CAUSES
        if (mechanism := cause.name.partition(".")[2]) in VIEW
    ]


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
    """Modalities behind the labels, of tasks without a measured hand, which shows it better.

    Where contact is labelled, it shows the delay of vector sensors.
    """
    result = []
    modalities = task.modalities.items() if HAND not in task.observations else ()
    by_contact = {key for key in task.observations if key not in task.images} if has_labels_only(task) else set()
    for modality in (modality for modality, keys in modalities if not by_contact & {*keys}):
        changed = f"{OBJECT}|object match/*|{_downstream(modality)}"
        title = "Image delayed" if modality == "image" else f"Modality {display_name(modality)} delayed"
        symptoms, action = (Symptom(f"lag/labels {modality}/*", -1),), "Synchronise the clocks of the sensors."
        result.append(Cause(f"{modality}.delay", title, symptoms, changed, action, f"advance {modality}"))
    return tuple(result)


def _models(task: Task) -> tuple[Cause, ...]:
    """Causes in measurement models of modalities that the catalog does not have, or whose sensors it cannot check.

    These are sensors of other names and, without a measured hand, force and torque: their signs and axes.
    """
    check = "Check the calibration of its sensors, whose offsets and scales have the same symptoms. "
    checked = {*KNOWN} if HAND in task.observations else {"image"}
    names = [name for name, keys in task.modalities.items() if name not in MODALITIES or not {*keys} & checked]
    title = "Sensors or model of {}"  # their fusion weights may depend on their models
    return tuple(c for n in names for c in model.causes_of(n, title.format(display_name(n)), check, WEIGHTS))


def _labels(task: Task) -> tuple[Cause, ...]:
    """Delayed labels of tasks without a measured hand: behind all modalities and, if these cause changes, the controls.

    A faulty sensor can make a single modality appear early.
    """
    if HAND in task.observations:
        return ()
    (delay,) = (cause for cause in data.CAUSES if cause.name == "labels.delay")
    (_, dynamics) = delay.symptoms
    lag = Symptom("lag/labels/*|lag/dynamics/*", 1, 2.0)
    controls = Symptom("control lag/*", -1, optional=True)
    return (replace(delay, symptoms=(lag, replace(dynamics, optional=True), controls)),)


def _controls(task: Task) -> tuple[Cause, ...]:
    """Causes in controls that do not command a measured hand, and in their use.

    Two things show such controls: the changes of the labels, where a regression on the controls explains them, and the
    dynamics model of a filter. An opposite sign is also a wrong scale, and inverted dynamics, by their slope, are also
    frozen ones: the prior prefers them.
    """
    if not task.control_size or commands_hand(task):
        return ()
    # Updates of single modalities, which stand in for measurements, depend on the prediction.
    changed = f"control gain/*|lag/dynamics/*|{LABELS}|{DYNAMICS}"
    used = Symptom("dynamics slope/*|dynamics spread/*|control gain/*", 0, optional=True)
    return (
        Cause(
            "control.delay",
            "Controls delayed",
            (Symptom("control lag/*", otherwise=(Symptom("lag/dynamics/*", -1),)),),
            changed,
            "Synchronise the controls with the sensors.",
            "advance control",
        ),
        Cause(
            "control.scale",
            "Controls with a wrong scale, sign or order",
            (Symptom("control gain/*", 0, otherwise=(Symptom("size/control*", 0),)), used),
            f"control lag/*|size/control*|{changed}",
            "Check the units, signs and order of the controls.",
            "scale control",
        ),
        Cause(
            "control.sign",
            "Controls with the opposite sign",
            (
                Symptom("opposed/control*", otherwise=(Symptom("control gain/*", target="mirrored"),)),
                Symptom("control gain/*", 0, optional=True),
            ),
            f"control lag/*|{changed}",
            "Check the sign convention of the controls.",
            "negate control|scale control",
            prior=0.2,
        ),
        Cause(
            "dynamics.inverted",
            "Dynamics inverted: predicted changes have the wrong sign",
            (Symptom("dynamics slope/*", target="mirrored"),),
            f"opposed/control*|lag/dynamics/*|{LABELS}|{DYNAMICS}",
            "Check the sign of the controls in the dynamics model.",
            prior=0.2,
        ),
    )


def _weights(task: Task) -> tuple[Cause, ...]:
    """Fusion weights that ignore one of two modalities of other names than those of the catalog."""
    if len(task.modalities) != 2 or set(task.modalities) == set(MODALITIES):
        return ()
    return tuple(
        Cause(
            f"weights.ignores_{name}",
            f"Fusion weights ignore {display_name(name)}",
            (
                Symptom(f"beta logit/{name}*", -1, otherwise=(Symptom(f"beta logit/{other}*", 1),)),
                Symptom("beta logit/*", target="shifted"),
            ),
            f"beta spread/*|{FILTER}",
            fusion.RETRAIN,
            "healthy beta",
        )
        for name, other in zip(task.modalities, reversed([*task.modalities]), strict=True)
    )


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

"""Causes in the sensors of a user's task, by the names of its observations and modalities."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from beliefscope.datasets.task import Task, display_name
from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes import image
from beliefscope.inspect.diagnosis.causes.consequences import LABELS, WEIGHTS, model_of
from beliefscope.inspect.diagnosis.causes.image import OBJECT
from beliefscope.inspect.diagnosis.causes.own_arrays import array_causes
from beliefscope.inspect.diagnosis.checks.readings import modelled_sensors
from beliefscope.inspect.diagnosis.checks.vectors import FORCE, TORQUE, has_labels_only
from beliefscope.inspect.statistics.array_channels import array_keys, channel_names
from beliefscope.inspect.statistics.reference_images import HAND

KNOWN = ("image", "force", "torque", "effector_position", "contact")
"""Observations that have their own causes."""

SYNCHRONISE = "Synchronise the clocks of the sensors."
"""Next action of a delay."""

BIASED = ("level", "drift", "saturation", "contact lag", "reading bias", "reading ratio")
"""Kinds of statistics of vector sensors that a bias changes."""

DELAYED = (
    *BIASED,
    "reading drift",
    "change",
    "size",
    "roughness",
    "reading gain",
    "reading noise",
    "reading outliers",
    "reading scatter",
    "inverted",
    "exchanged",
)
"""As ``BIASED``, of a delay."""

NOT_LATE = ("[!r]*", "r[!e]*", "reading [!l]*")
"""All kinds but ``reading lag``, that of new readings: a sensor that is stuck has no delay."""

CONNECTION = "Check the connection of the sensor and the load of the computer that receives its messages."
"""Next action of lost readings."""

SLOW = -0.1
"""Prior of a drift: slow readings with a delay or a gain also drift."""

TARE = "Tare the sensor, or register the frame of the labels with it: only other sensors can show which is wrong."
"""Next action of a bias."""

WARM = "Let the sensor warm up and tare it before each episode."
"""Next action of a drift."""

VECTOR = (
    ("stuck", "stuck", "stuck", "Restart the sensor and check its connection."),
    ("saturation", "saturation", "saturated", "Extend the measuring range of the sensor."),
)
"""Kinds of the statistic, mechanism, word of the title, next action."""

IMAGE = (
    ("black|losses", "blackout", "blacked out", "Check the camera and its driver."),
    ("frozen", "frozen", "frozen", "Check the camera and its driver."),
)
"""As ``VECTOR``, of images."""

VIEW = {
    "noise": "Image of {} noisy",
    "blur": "Image of {} blurred",
    "exposure": "Image exposure of {} changed",
    "occlusion": "Image of {} occluded",
}
"""Mechanisms of causes in the image that other cameras have as well -> title."""

PREFERRED = -0.1
"""Prior of an occlusion: a camera that has moved shows other parts of the scene as well, and moves the object."""


def sensor_causes(task: Task) -> tuple[Cause, ...]:
    """Causes in the sensors of a task that have none in the catalog."""
    arrays = array_keys(task)
    known = KNOWN if HAND in task.observations else ("image", "contact")  # the physics of force and torque
    keys = {key: modality for modality, keys in task.modalities.items() for key in keys if key not in known}
    result = []
    for key, modality in keys.items():
        others = f"lag/*|{_downstream(modality)}"
        changed = f"{_patterns(key, '*')}|{others}"
        for kinds, mechanism, word, action in IMAGE if key in task.images else VECTOR:
            symptom = Symptom(_patterns(key, *kinds.split("|")))
            title = f"Sensor {display_name(key)} {word}"
            explained = f"{_patterns(key, *NOT_LATE)}|{others}" if mechanism == "stuck" else changed
            result.append(Cause(f"{key}.{mechanism}", title, (symptom,), explained, action, f"drop {modality}"))
        if key in task.masks:
            lost = Symptom(_patterns(key, "absent"))
            title = f"Readings of sensor {display_name(key)} lost"
            result.append(Cause(f"{key}.dropout", title, (lost,), changed, CONNECTION, f"drop {modality}"))
        is_vector = len(task.observations[key]) == 1 or key in task.clouds
        result += _changed_readings(key, modality) if is_vector else []
        result += _sparse_cloud(key, modality) if key in task.clouds else []
        result += array_causes(key, _downstream(modality), f"drop {modality}") if key in arrays else []
        result += _changed_views(key, modality) if key in task.images else []
    for key in (key for key in modelled_sensors(task) if key not in arrays):
        result += _wrong_channels(task, key)
    parts = (_moved_cameras, _delays, _delayed_modalities)
    return (*result, *(cause for part in parts for cause in part(task)))


def _patterns(key: str, *kinds: str) -> str:
    """Patterns of the statistics of these kinds about a sensor or one of its axes."""
    return "|".join(f"{kind}/{key}/*|{kind}/{key} */*" for kind in kinds)


def _changed_readings(key: str, modality: str) -> list[Cause]:
    """Noise, bias, drift and gain of a vector sensor. A gain changes size and noise alike, noise their ratio.

    A bias of a part of an episode adds to the noise around the mean error.
    """
    of = partial(_patterns, key)
    delays = ("reading lag", "reading lag scatter")
    noises = ("noise", "reading noise", "reading outliers")
    scaled = of(*BIASED, "reading drift", *delays, "change", "size", *noises, "reading scatter")
    outliers = Symptom(of("reading outliers"))
    noise = (Symptom(of("noise"), otherwise=(outliers,)), Symptom(of("roughness", "reading noise"), optional=True))
    line = Symptom(of("drift"), 0)  # of channels without expected readings: a bias in the course of the episode as well
    bias = (Symptom(of("level"), 0, otherwise=(Symptom(of("reading bias"), 0), line)),)
    drift = (Symptom(of("reading drift"), 0, otherwise=(line,)),)
    slope = (Symptom(of("reading gain"), 0), Symptom(of("reading ratio"), 0))
    gain = (Symptom(of("size"), 0, otherwise=slope), Symptom(of("noise"), 0, otherwise=slope))
    rough = f"{scaled}|{of('roughness')}"
    entries = (
        ("noise", "noisy", noise, rough, "Check the cable and the filter of the sensor.", ""),
        ("bias", "biased", bias, of(*BIASED, *delays), TARE, f"tare {key}|"),
        ("drift", "drifting", drift, of(*BIASED, "reading scatter", *delays), WARM, f"detrend {key}|"),
        ("gain", "has a wrong gain", gain, scaled, "Check the unit and the gain of the sensor.", f"scale {key}|"),
    )
    return [
        Cause(
            f"{key}.{mechanism}",
            f"Sensor {display_name(key)} {words}",
            symptoms,
            f"{changed}|{_downstream(modality)}",
            action,
            f"{undo}drop {modality}",
            lowers=of("stuck") if mechanism == "noise" else "",
            raises=of(*noises) if mechanism in ("bias", "drift") else "",
            prior=SLOW if mechanism == "drift" else 0.0,
        )
        for mechanism, words, symptoms, changed, action, undo in entries
    ]


def _wrong_channels(task: Task, key: str) -> list[Cause]:
    """Inverted and exchanged channels of a vector sensor."""
    modality = next(name for name, keys in task.modalities.items() if key in keys)
    changed = f"{_patterns(key, '*')}|lever/*|axes/*|direction/*|{_downstream(modality)}"
    name, action = display_name(key), "Check the axes and signs of the sensor."
    entries = [("sign", f"Sensor {name} has inverted channels", "inverted")]
    count = len(channel_names(task, key)) or task.observations[key][0]
    entries += [("axes", f"Channels of sensor {name} exchanged", "exchanged")] if count > 1 else []
    undo = f"rearrange {key}|drop {modality}"
    return [
        Cause(f"{key}.{m}", title, (Symptom(_patterns(key, kind)),), changed, action, undo)
        for m, title, kind in entries
    ]


def _sparse_cloud(key: str, modality: str) -> list[Cause]:
    """Absent points of a point cloud."""
    changed = f"{_patterns(key, '*')}|lag/*|{_downstream(modality)}"
    title, action = f"Points of sensor {display_name(key)} lost", "Check the range and the surfaces that it sees."
    return [Cause(f"{key}.holes", title, (Symptom(f"holes/{key}/all"),), changed, action, f"drop {modality}")]


def _changed_views(key: str, modality: str) -> list[Cause]:
    """Causes of ``VIEW`` with the names of the sensor and its modality.

    The edges of an object in front of the camera change the sharpness as well.
    """

    def renamed(patterns: str) -> str:
        return patterns.replace("/image", f"/{key}").replace("*image*", f"*{modality}*")

    def of_sensor(symptom: Symptom) -> Symptom:
        otherwise = tuple(map(of_sensor, symptom.otherwise))
        return replace(symptom, statistics=renamed(symptom.statistics), otherwise=otherwise)

    return [
        replace(
            cause,
            name=f"{key}.{mechanism}",
            title=VIEW[mechanism].format(display_name(key)),
            symptoms=tuple(map(of_sensor, cause.symptoms)),
            consequences=renamed(cause.consequences) + (f"|sharpness/{key}/*" if mechanism == "occlusion" else ""),
            lowers=renamed(cause.lowers),
            next=cause.by_hand or cause.next,
            command=None,
            undo=f"drop {modality}",
            prior=PREFERRED if mechanism == "occlusion" else 0.0,
        )
        for cause in image.CAUSES
        if (mechanism := cause.name.partition(".")[2]) in VIEW
    ]


def _downstream(modality: str) -> str:
    """Statistics that a fault in a sensor of a modality changes downstream."""
    return f"{model_of(modality)}|likelihood share/*|{LABELS}|{WEIGHTS}"


def offset_of(modality: str, weight: float = 1.0) -> Symptom:
    """Offset of the measurement model of a modality at the true states."""
    return Symptom(f"innovation offset/{modality} *|likelihood offset/{modality} *", 0, weight, optional=True)


def _moved_cameras(task: Task) -> tuple[Cause, ...]:
    """Cameras of tasks without a measured hand, whose position only the labels show: labels with an offset are alike.

    A second sensor of the position separates the two: it agrees with the labels if the camera has moved.
    """
    result = []
    for modality, keys in task.modalities.items() if HAND not in task.observations else ():
        for key in (key for key in keys if key in task.images):
            changed = f"object match/*|occlusion/{key}/*|brightness/{key}/*|sharpness/{key}/*|{_downstream(modality)}"
            title = "Camera moved" if key in ("image", "camera") else f"Camera {display_name(key)} moved"
            symptoms = (
                Symptom(OBJECT, 0, otherwise=(Symptom(f"innovation drift/{modality} *", 0),)),
                Symptom(f"module bias/*{modality}*", 0, 0.5, unmeasured=(offset_of(modality),), optional=True),
                Symptom("module bias/*", 0, 0.3, "alone", optional=True),
            )
            undo = f"realign image|drop {modality}" if key == "image" else f"drop {modality}"
            result.append(Cause(f"{key}.shift", title, symptoms, changed, "Calibrate the camera pose again.", undo))
    return tuple(result)


def _delayed_modalities(task: Task) -> tuple[Cause, ...]:
    """Modalities behind the labels, of tasks without a measured hand, which shows it better.

    Where contact is labelled, it shows the delay of vector sensors, as labels show that of a modality's only sensor.
    """
    result = []
    modalities = task.modalities.items() if HAND not in task.observations else ()
    by_contact = {key for key in task.observations if key not in task.images} if has_labels_only(task) else set()
    alone = [{key} for key in _delayed_sensors(task)]
    for modality in (name for name, keys in modalities if not by_contact & {*keys} and {*keys} not in alone):
        changed = f"{OBJECT}|object match/*|{_downstream(modality)}"
        title = "Image delayed" if modality == "image" else f"Modality {display_name(modality)} delayed"
        symptoms = (Symptom(f"lag/labels {modality}/*", -1),)
        result.append(Cause(f"{modality}.delay", title, symptoms, changed, SYNCHRONISE, f"advance {modality}"))
    return tuple(result)


def _delayed_sensors(task: Task) -> list[str]:
    """Sensors other than images whose delay labelled contact, if no sensor measures it, or the labels show."""
    vectors = [key for key, shape in task.observations.items() if len(shape) == 1 and key != HAND]
    vectors += [*array_keys(task), *task.clouds]
    return vectors if has_labels_only(task) else modelled_sensors(task)


def _delays(task: Task) -> tuple[Cause, ...]:
    """Delays of vector sensors, arrays and point clouds behind the labels.

    Force and torque are of one sensor: a delay of the force explains that of the torque, and the laws of both.
    """
    result = []
    for key in _delayed_sensors(task):
        modality = next(name for name, keys in task.modalities.items() if key in keys)
        changed = f"{_patterns(key, *DELAYED)}|lag/*|{_downstream(modality)}"
        if key in (FORCE, TORQUE):
            changed += f"|lever/{FORCE}*|axes/{FORCE}/*|size/*/contact"
        if key == FORCE and TORQUE in task.observations:
            changed += f"|{_patterns(TORQUE, '*')}"
        alone = HAND not in task.observations and len(task.modalities[modality]) == 1
        otherwise = (Symptom(f"lag/labels {modality}/*", -1),) if alone else ()
        # The delay of a modality is exact only if its estimates are: one of the readings is preferred.
        symptoms = (
            Symptom(f"contact lag/{key}/*|reading lag/{key}/*", otherwise=otherwise),
            Symptom(f"reading lag/{key}/*", weight=2.0, optional=True),
        )
        title = f"Sensor {display_name(key)} delayed"
        # The readings of a sensor with gaps then jump at other steps than its gaps. A growing delay repeats some.
        raised = [*(["noise"] if key in task.masks else []), *([] if has_labels_only(task) else ["stuck"])]
        raises = _patterns(key, *raised)
        result.append(Cause(f"{key}.delay", title, symptoms, changed, SYNCHRONISE, f"advance {key}", raises=raises))
    return tuple(result)

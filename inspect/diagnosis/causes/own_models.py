"""Causes in the models, labels, controls and fusion weights of a user's task, by the names of its modalities."""

from __future__ import annotations

from dataclasses import replace

from beliefscope.datasets.task import Task, display_name
from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes import data, fusion, model
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, FILTER, LABELS, WEIGHTS
from beliefscope.inspect.diagnosis.causes.own_sensors import KNOWN, offset_of
from beliefscope.inspect.diagnosis.checks.readings import modelled_sensors
from beliefscope.inspect.diagnosis.checks.vectors import commands_hand
from beliefscope.inspect.statistics.reference_images import HAND

MODALITIES = ("image", "haptics")
"""Modalities whose measurement models have causes in the catalog."""


EXCHANGED = Cause(
    "weights.exchanged",
    "Fusion weights exchanged between modalities",
    (Symptom("beta logit/*|beta spread/*|beta contact/*", target="exchanged"),),
    WEIGHTS,
    "Check the order of the modalities in the filter and its weights.",
    prior=0.2,  # the variation of one of them may fall, as that of constant weights
)


def model_causes(task: Task) -> tuple[Cause, ...]:
    """Causes beyond the sensors that the catalog does not have for the task."""
    return tuple(cause for part in (_models, _labels, _controls, _weights) for cause in part(task))


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
    """Labels of tasks without a measured hand: delayed behind all modalities and, if these cause changes, the controls;
    or with an offset from all of them, by the object in images or by the readings of two modalities.

    A faulty sensor can make a single modality appear early, so each of them counts.
    """
    if HAND in task.observations:
        return ()
    (delay,) = (cause for cause in data.CAUSES if cause.name == "labels.delay")
    (_, dynamics) = delay.symptoms
    lag = Symptom("lag/labels/*|lag/dynamics/*", 1, 2.0, otherwise=(Symptom("reading lag/*", -1),))
    controls = Symptom("reading lag/control/*", -1, optional=True)
    sensors = [Symptom(f"reading lag/{key}/*", -1, optional=True) for key in modelled_sensors(task)]
    (offset,) = (cause for cause in data.CAUSES if cause.name == "labels.offset")
    objects, *_, common = offset.symptoms
    shift = Symptom("label shift/*", unmeasured=(objects,))  # a moved camera also shows the object elsewhere
    biases = [offset_of(modality, 0.3) for modality in task.modalities]
    return (
        replace(delay, symptoms=(lag, replace(dynamics, optional=True), controls, *sensors)),
        replace(
            offset,
            symptoms=(shift, replace(objects, optional=True), replace(common, optional=True), *biases),
            consequences=f"{offset.consequences}|reading */*|measurement function/*|innovation spread/*",
        ),
    )


def _controls(task: Task) -> tuple[Cause, ...]:
    """Causes in controls that do not command a measured hand, and in their use.

    Two things show such controls: the labels, where these explain them, and the dynamics model of a filter. Inverted
    dynamics, by their slope, are also frozen ones: the prior prefers them.
    """
    if not task.control_size or commands_hand(task):
        return ()
    # Updates of single modalities, which stand in for measurements, depend on the prediction.
    # Expected readings may depend on the controls, such as those in a frame whose heading is one.
    sensors = "|".join(f"exchanged/{key}*|inverted/{key}*" for key in modelled_sensors(task))
    changed = "|".join(filter(None, ("reading */*", sensors, "lag/dynamics/*", LABELS, DYNAMICS)))
    used = Symptom("dynamics slope/*|dynamics spread/*|reading gain/control*", 0, optional=True)
    return (
        Cause(
            "control.delay",
            "Controls delayed",
            (Symptom("reading lag/control/*", unmeasured=(Symptom("lag/dynamics/*", -1),)),),
            f"inverted/control*|exchanged/control*|{changed}",
            "Synchronise the controls with the sensors.",
            "advance control",
        ),
        Cause(
            "control.scale",
            "Controls scaled",
            (Symptom("reading gain/control*", 0, unmeasured=(Symptom("size/control*", 0),)), used),
            f"size/control*|{changed}",
            "Check the units of the controls.",
            "scale control",
        ),
        Cause(
            "control.bias",
            "Controls biased",
            (Symptom("reading bias/control*|reading drift/control*", 0),),
            changed,
            "Calibrate the zero of the controls.",
        ),
        Cause(
            "control.axes",
            "Control channels exchanged",
            (Symptom("exchanged/control*"),),
            f"inverted/control*|opposed/control*|size/control*|{changed}",
            "Check the order of the controls.",
            "rearrange control",
        ),
        Cause(
            "control.sign",
            "Control sign inverted",
            (Symptom("inverted/control*", otherwise=(Symptom("opposed/control*"),)),),
            f"opposed/control*|{changed}",
            "Check the sign convention of the controls.",
            "rearrange control|negate control",
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
    """Fusion weights of several modalities that are exchanged; or that ignore one of two, if the catalog has no cause.

    Exchanged weights of two modalities are called inverted.
    """
    if len(task.modalities) > 2:
        return (EXCHANGED,)
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
            "Fine-tune them",
            "healthy beta",
            command=fusion.RETRAIN,
            by_hand=fusion.CORRECT,
        )
        for name, other in zip(task.modalities, reversed([*task.modalities]), strict=True)
    )

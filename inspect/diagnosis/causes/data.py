"""Causes in the labels, and data that differ from the training data as a whole."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, LABELS, WEIGHTS

MODULES = f"module */*|{WEIGHTS}|{DYNAMICS}"

CAUSES = (
    Cause(
        "labels.delay",
        "Labels delayed",
        (Symptom("lag/labels*", 1), Symptom("dynamics error/*|dynamics spread/*|dynamics slope/*", 0)),
        f"{LABELS}|{MODULES}",
        "Synchronise the clock of the motion capture with the sensors.",
    ),
    Cause(
        "labels.offset",
        "Labels offset",
        (Symptom("module bias/*image*", 0), Symptom("module bias/*", 0, 0.3, "common")),
        f"{LABELS}|{MODULES}",
        "Register the frame of the motion capture with the robot's.",
    ),
    Cause(
        "data.shift",
        "Data differ from the training data as a whole",
        (
            Symptom("sharpness/image/*|occlusion/image/*|shift/image*", 0),
            Symptom("lever/force*|size/force/*|size/torque/*|axes/force/*", 0),
            Symptom("module error/*", 1),
        ),
        f"sharpness/*|occlusion/*|shift/*|brightness/*|offset/*|*/force*|*/torque*|*/contact/*|{LABELS}|{MODULES}",
        "Collect data of these conditions and fine-tune: `beliefscope finetune {task} --filter {filter} --data NEW.h5 "
        "-o tuned.safetensors`.",
        prior=-0.4,
    ),
)

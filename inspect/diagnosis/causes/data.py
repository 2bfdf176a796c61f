"""Causes in the labels, and data that differ from the training data as a whole."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, FILTER, LABELS, WEIGHTS
from beliefscope.inspect.diagnosis.causes.image import OBJECT

MODULES = f"module */*|{WEIGHTS}|{DYNAMICS}"

BY_LABELS = "|".join(f"module {kind}/*" for kind in ("bias", "error", "nis", "spread", "scatter"))
"""Statistics of modules that compare them with the labels."""

CAUSES = (
    Cause(
        "labels.delay",
        "Labels delayed",
        (
            Symptom("lag/labels*|lag/dynamics/*", 1, 2.0),
            Symptom("dynamics error/*|dynamics spread/*|dynamics slope/*", 0),
        ),
        f"{OBJECT}|object match/image*|{LABELS}|{BY_LABELS}|{FILTER}|{DYNAMICS}",
        "Synchronise the clock of the motion capture with the sensors.",
    ),
    Cause(
        "labels.offset",
        "Labels offset",
        (
            Symptom(f"module bias/*image*|{OBJECT}", 0),
            Symptom(OBJECT, 0, optional=True),
            Symptom("module bias/*", 0, 0.3, "common"),
        ),
        f"object match/image*|{LABELS}|{BY_LABELS}|{FILTER}|{DYNAMICS}",
        "Register the frame of the motion capture with the robot's.",
    ),
    Cause(
        "data.shift",
        "Data differ from the training data as a whole",
        (
            Symptom("module error/*", 1),
            Symptom(
                "module power/*|object match/image*|sharpness/image/*|occlusion/image/*|shift/image*|lever/force*"
                "|size/*",
                0,
            ),
        ),
        f"{OBJECT}|object match/image*|sharpness/*|occlusion/*|shift/*|brightness/*|offset/*|*/force*|*/torque*"
        f"|*/contact/*|{LABELS}|{MODULES}",
        "Collect data of these conditions and fine-tune: `beliefscope finetune {task} --filter {filter} --data NEW.h5 "
        "-o tuned.safetensors`.",
        prior=-0.4,
    ),
)

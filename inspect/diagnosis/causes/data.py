"""Causes in the labels, and data that differ from the training data as a whole."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Command, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import CONTACT_DISTANCE, DYNAMICS, FILTER, LABELS, WEIGHTS
from beliefscope.inspect.diagnosis.causes.image import OBJECT

MODULES = f"module */*|{WEIGHTS}|{DYNAMICS}"

BY_LABELS = "|".join(f"module {kind}/*" for kind in ("bias", "error", "nis", "spread", "scatter"))
"""Statistics of modules that compare them with the labels."""

CONTACTS = (
    "|".join(f"{kind}/*" for kind in ("size", "lever", "direction", "axes", "change", "noise", "saturation"))
    + "|roughness/*|*/contact/*"
)
"""Statistics of forces and torques in contact, which depend on the physics; free motion has no information."""

CAUSES = (
    Cause(
        "labels.delay",
        "Labels delayed",
        (
            Symptom("lag/labels*|lag/dynamics/*", 1, 2.0),
            Symptom("dynamics error/*|dynamics spread/*|dynamics slope/*", 0),
        ),
        f"{OBJECT}|object match/*|{CONTACT_DISTANCE}|{LABELS}|{BY_LABELS}|{FILTER}|dynamics nis/*|lag/dynamics/*"
        "|label shift/*|reading lag/*|reading bias/*|reading drift/*|reading gain/*|reading noise/*|reading scatter/*",
        "Synchronise the clock of the motion capture with the sensors.",
        "advance labels",
    ),
    Cause(
        "labels.offset",
        "Labels offset",
        (
            Symptom(f"module bias/*image*|{OBJECT}", 0),
            Symptom(OBJECT, 0, optional=True),
            Symptom("module bias/*", 0, 0.3, "common"),
        ),
        f"object match/*|contact distance error/*|contact distance scatter/*|{LABELS}|{BY_LABELS}|{FILTER}|{DYNAMICS}"
        "|reading bias/*|reading drift/*",
        "Register the frame of the motion capture with the robot's.",
        "shift labels",
    ),
    Cause(
        "data.shift",
        "Data differ from the training data as a whole",
        (
            Symptom("module error/*", 1),
            Symptom(
                "module power/*|object match/*|sharpness/image/*|occlusion/image/*|shift/image*|lever/force*"
                "|size/*|contact distance/*",
                0,
            ),
        ),
        f"{OBJECT}|object match/*|contact distance/*|contact distance error/*|sharpness/*|occlusion/*|shift/*"
        "|brightness/*|offset/*"
        f"|{CONTACTS}|{LABELS}|{MODULES}",
        "Collect data of these conditions and fine-tune",
        prior=-0.4,
        command=Command("finetune", "--data NEW.h5"),
        by_hand="Collect data of these conditions.",
    ),
)

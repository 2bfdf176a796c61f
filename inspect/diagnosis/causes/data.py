"""Causes in the labels, and data that differ from the training data as a whole."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, WEIGHTS

MODULES = f"module */*|{WEIGHTS}|{DYNAMICS}"

CAUSES = (
    Cause(
        "labels.delay",
        "Labels delayed",
        (Symptom("lag/labels/*", 0),),
        f"offset/labels*|{MODULES}",
        "Synchronise the clock of the motion capture with the sensors.",
    ),
    Cause(
        "labels.offset",
        "Labels offset",
        (Symptom("offset/labels*", 0),),
        MODULES,
        "Register the frame of the motion capture with the robot's.",
    ),
)

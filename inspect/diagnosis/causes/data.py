"""Causes in the labels, and data that differ from the training data as a whole."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, WEIGHTS

LABELS = "label_lag/*|label_offset/*|shared_label_*"
"""Labels against the modalities."""

MODULES = f"module */*|{WEIGHTS}|{DYNAMICS}"

CAUSES = (
    Cause(
        "labels.delay",
        "Labels delayed",
        (Symptom("shared_label_lag/*", 0),),
        f"{LABELS}|{MODULES}",
        "Synchronise the clock of the motion capture with the sensors.",
    ),
    Cause(
        "labels.offset",
        "Labels offset",
        (Symptom("shared_label_offset/*", 0),),
        f"{LABELS}|{MODULES}",
        "Register the frame of the motion capture with the robot's.",
    ),
)

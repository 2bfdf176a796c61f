"""Causes in the hand position, the contact flag, the clock of the haptic sensors, and the controls."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, HAPTICS

IN_PHASES = "|".join(f"{kind}/*" for kind in ("level", "drift", "change", "size", "lever", "axes", "direction"))
"""Statistics of force and torque in free motion or in contact."""

CAUSES = (
    Cause(
        "effector.offset",
        "End-effector position offset",
        (Symptom("offset/effector_position*", 0),),
        f"{HAPTICS}|{DYNAMICS}",
        "Calibrate the robot's kinematics against the camera.",
        "drop haptics",
    ),
    Cause(
        "contact.stuck",
        "Contact flag stuck",
        (
            Symptom("agreement/contact/*|unflagged force/contact/*|share/contact/*", 0),
            Symptom("share/contact/*|change/force*", 0, 0.5),
        ),
        f"{IN_PHASES}|lag/contact/*|lag/image/*|lag/dynamics/*|{HAPTICS}|{DYNAMICS}",
        "Check the contact sensor or its threshold.",
        "drop haptics",
    ),
    Cause(
        "haptics.delay",
        "Haptics delayed",
        (Symptom("lag/image/*", -1),),
        f"lag/contact/*|offset/effector_position*|direction/force/*|{HAPTICS}|{DYNAMICS}",
        "Synchronise the clocks of camera and robot.",
        "advance haptics",
    ),
    Cause(
        "control.delay",
        "Controls delayed",
        (Symptom("lag/control/*", 1),),
        f"scale/control/*|offset/control*|lag/dynamics/*|{DYNAMICS}",
        "Synchronise the controls with the sensors.",
        "advance control",
    ),
    Cause(
        "control.scale",
        "Controls scaled",
        (Symptom("scale/control/*", 0),),
        f"offset/control*|{DYNAMICS}",
        "Check the units of the controls.",
        "scale control",
    ),
)

"""Causes in the hand position, the contact flag, the clock of the haptic sensors, and the controls."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import CONTACT_DISTANCE, DYNAMICS, HAPTICS, IMPEDANCE
from beliefscope.inspect.diagnosis.causes.image import HAND, LANDMARKS

IN_PHASES = "|".join(
    f"{kind}/*" for kind in ("level", "drift", "change", "size", "roughness", "lever", "axes", "direction")
)
"""Statistics of force and torque in free motion or in contact."""

LAGS = "lag/contact/*|lag/image/*|lag/dynamics/*"
"""Delays that are measured with the contact flag or with controls that contain it."""

CAUSES = (
    Cause(
        "effector.offset",
        "End-effector position offset",
        (Symptom(HAND, 0, otherwise=(Symptom("offset/control*", 0),)),),
        f"{CONTACT_DISTANCE}|{HAPTICS}|{DYNAMICS}",
        "Calibrate the robot's kinematics against the camera.",
        "shift hand|drop haptics",
    ),
    Cause(
        "effector.noise",
        "End-effector position noisy",
        (Symptom("position noise/effector_position*"),),
        f"{LANDMARKS}|direction/force/*|scale/control/*|lag/control/*|{IMPEDANCE}|{LAGS}|{CONTACT_DISTANCE}|{HAPTICS}"
        f"|{DYNAMICS}",
        "Check the joint encoders and the filter of the robot's kinematics.",
        "drop haptics",
    ),
    Cause(
        "contact.stuck",
        "Contact flag stuck",
        (
            Symptom("agreement/contact/*|unflagged force/contact/*|share/contact/*", 0),
            Symptom("share/contact/*|change/force*", 0, 0.5),
        ),
        f"opposition/contact/extreme|{IN_PHASES}|{LAGS}|{CONTACT_DISTANCE}|{HAPTICS}|{DYNAMICS}",
        "Check the contact sensor or its threshold.",
        "restore contact|drop haptics",
        lowers="toggles/contact/*",
    ),
    Cause(
        "contact.inverted",
        "Contact flag inverted",
        (
            Symptom("agreement/contact/*", -1),
            Symptom("toggles/contact/*|opposition/contact/*"),
        ),
        f"share/contact/*|unflagged force/contact/*|{IN_PHASES}|{LAGS}|{CONTACT_DISTANCE}|{HAPTICS}|{DYNAMICS}",
        "Check the sign and the threshold of the contact sensor.",
        "restore contact|drop haptics",
    ),
    Cause(
        "contact.delay",
        "Contact flag delayed",
        (Symptom("lag/contact/*"),),
        f"agreement/contact/*|opposition/contact/*|unflagged force/contact/*|level/*|change/*|size/*|lever/*"
        f"|roughness/*|direction/*|{LAGS}|{CONTACT_DISTANCE}|{HAPTICS}|{DYNAMICS}",
        "Synchronise the contact sensor with the force sensor.",
        "restore contact|drop haptics",
    ),
    Cause(
        "haptics.dropout",
        "Haptics lost: all readings repeat the last one",
        (Symptom("stuck/effector_position*"), Symptom("stuck/force*|stuck/torque*", 1, 0.3)),
        f"*/force*|*/torque*|*/contact/*|lag/*|shift/image*|scale/control/*|offset/*|following/*|{LANDMARKS}"
        f"|position noise/*|{CONTACT_DISTANCE}|{HAPTICS}|{DYNAMICS}",
        "Check the connection of the wrist sensor and the robot; until then, run the filter without haptics.",
        "drop haptics",
    ),
    Cause(
        "haptics.delay",
        "Haptics delayed",
        (Symptom("lag/image/*", -1, otherwise=(Symptom("following/control*", 1),)),),
        f"{IMPEDANCE}|lag/contact/*|lag/control/*|lag/dynamics/*|{LANDMARKS}|level/*|direction/force/*"
        f"|{CONTACT_DISTANCE}|{HAPTICS}|{DYNAMICS}",
        "Synchronise the clocks of camera and robot.",
        "advance haptics",
    ),
    Cause(
        "control.delay",
        "Controls delayed",
        (Symptom("lag/control/*", 1, otherwise=(Symptom("following/control*", -1),)),),
        f"scale/control/*|{IMPEDANCE}|lag/dynamics/*|{DYNAMICS}",
        "Synchronise the controls with the sensors.",
        "advance control",
    ),
    Cause(
        "control.scale",
        "Controls scaled",
        (Symptom("step scale/control/*", 0, unmeasured=(Symptom("scale/control/*", 0),)),),
        f"scale/control/*|offset/control*|{DYNAMICS}",
        "Check the units of the controls.",
        "scale control",
    ),
)

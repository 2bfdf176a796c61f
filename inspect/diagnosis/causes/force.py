"""Causes in the force/torque sensor."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import HAPTICS, IMPEDANCE

CONTACT = "agreement/contact/*|opposition/contact/*|unflagged force/contact/*|lag/contact/*"
"""Relations of the force and the contact flag."""

READINGS = (
    "level/force*|drift/force*|change/force*|noise/force*|size/force/*|roughness/force/*|lever/force*|axes/force/*"
    f"|direction/force/*|{IMPEDANCE}"
)
"""Statistics of the values of the force."""

CAUSES = (
    Cause(
        "force.bias",
        "Force biased",
        (Symptom("level/force*", 0),),
        f"drift/force*|direction/force/*|offset/control*|{CONTACT}|{HAPTICS}",
        "Tare the force sensor in free motion.",
        "tare force",
    ),
    Cause(
        "force.drift",
        "Force drifting",
        (Symptom("drift/force*", 0),),
        f"level/force*|direction/force/*|size/force/*|roughness/force/*|axes/force/*|lever/force*|{IMPEDANCE}"
        f"|{CONTACT}|{HAPTICS}",
        "Tare the force sensor before each run and check its temperature.",
        "detrend force",
    ),
    Cause(
        "force.gain",
        "Force gain wrong",
        (
            Symptom("lever/force*|size/force/*|compliance/force*", 0),
            Symptom("size/force/*|noise/force*|compliance/force*", 0),
        ),
        f"level/force*|drift/force*|change/force*|saturation/force*|{CONTACT}|{HAPTICS}",
        "Check the units and the calibration of the force sensor.",
        "scale force",
    ),
    Cause(
        "force.sign",
        "Force sign inverted",
        (
            Symptom("direction/force/*", 1),
            Symptom("lever/force*", 0),
            Symptom("compliance/force*", -1, optional=True),
        ),
        f"level/force*|drift/force*|{CONTACT}|{HAPTICS}",
        "Invert the force, or correct the frame of the sensor.",
        "negate force",
    ),
    Cause(
        "force.axes",
        "Force axes exchanged",
        (Symptom("axes/force/*", -1),),
        f"lever/force*|direction/force/*|level/force*|drift/force*|noise/force*|stuck/force*|{IMPEDANCE}|{CONTACT}"
        f"|{HAPTICS}",
        "Correct the frame of the force sensor.",
        "permute force|drop haptics",
    ),
    Cause(
        "force.noise",
        "Force noisy",
        (Symptom("noise/force*"), Symptom("roughness/force/*|change/force*", optional=True)),
        f"{READINGS}|{CONTACT}|{HAPTICS}",
        "Check the cable and the filter of the force sensor.",
        "drop haptics",
    ),
    Cause(
        "force.saturation",
        "Force saturated",
        (Symptom("saturation/force*"),),
        f"stuck/force*|{READINGS}|{CONTACT}|{HAPTICS}",
        "Extend the measuring range of the force sensor, or reduce the forces.",
        "drop haptics",
    ),
    Cause(
        "force.stuck",
        "Force stuck",
        (Symptom("stuck/force*"),),
        f"{READINGS}|{CONTACT}|{HAPTICS}",
        "Restart the force sensor.",
        "drop haptics",
    ),
    Cause(
        "torque.bias",
        "Torque biased",
        (Symptom("level/torque*", 0),),
        f"drift/torque*|saturation/torque*|{HAPTICS}",
        "Tare the torque sensor in free motion.",
        "tare torque|drop haptics",
    ),
    Cause(
        "torque.noise",
        "Torque noisy",
        (Symptom("noise/torque*"),),
        f"level/torque*|drift/torque*|change/torque*|size/torque/*|lever/force*|axes/force/*|{HAPTICS}",
        "Check the cable and the filter of the torque sensor.",
        "drop haptics",
    ),
)

"""Causes in the dynamics model, its process noise, and the reported covariance."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Command, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, FILTER

RETRAIN = Command("finetune", train="dynamics-only")
CALIBRATE = Command("finetune", train="noise-only")
COMPARE = "Compare Q with the errors of the predictions."

CAUSES = (
    Cause(
        "dynamics.bias",
        "Dynamics biased",
        (Symptom("dynamics bias/*", 0),),
        f"dynamics error/*|dynamics nis/*|{FILTER}",
        "Fine-tune it",
        "shift dynamics",
        lowers="lag/dynamics/*",
        command=RETRAIN,
        by_hand="Check the inputs, frames and constants of the dynamics.",
    ),
    Cause(
        "dynamics.frozen",
        "Dynamics frozen: predicted changes are too small",
        (Symptom("dynamics slope/*|dynamics spread/*", -1),),
        f"dynamics error/*|dynamics nis/*|{FILTER}",
        "Fine-tune it",
        "scale dynamics",
        lowers="lag/dynamics/*",
        command=RETRAIN,
        by_hand="Check the time step, units and gains of the dynamics.",
    ),
    Cause(
        "dynamics.broken",
        "Dynamics broken",
        (Symptom("dynamics error/*|dynamics bias/*", 0), Symptom("dynamics spread/*|dynamics slope/*", 0)),
        DYNAMICS,
        "Fine-tune it",
        "restore dynamics",
        lowers="lag/dynamics/*",
        prior=-0.2,
        command=RETRAIN,
        by_hand="Check the equations of the dynamics.",
    ),
    Cause(
        "process_noise.small",
        "Process noise too small",
        (Symptom("process noise/*", -1), Symptom("dynamics nis/*", 1)),
        FILTER,
        "Calibrate it",
        "rescale process noise",
        command=CALIBRATE,
        by_hand=COMPARE,
    ),
    Cause(
        "process_noise.large",
        "Process noise too large",
        (Symptom("process noise/*", 1), Symptom("dynamics nis/*", -1)),
        FILTER,
        "Calibrate it",
        "rescale process noise",
        command=CALIBRATE,
        by_hand=COMPARE,
    ),
    Cause(
        "covariance.small",
        "Reported covariance too small",
        (Symptom("reported variance/*", -1),),
        FILTER,
        "Report the covariance of the belief without scaling it.",
        "restore equations",
    ),
    Cause(
        "covariance.large",
        "Reported covariance too large",
        (Symptom("reported variance/*", 1),),
        FILTER,
        "Report the covariance of the belief without scaling it.",
        "restore equations",
    ),
)

"""Causes in the dynamics model, its process noise, and the reported covariance."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, FILTER

RETRAIN = "Fine-tune it: `beliefscope finetune {task} --filter {filter} --train dynamics-only -o tuned.safetensors`."
CALIBRATE = "Calibrate it: `beliefscope finetune {task} --filter {filter} --train noise-only -o tuned.safetensors`."

CAUSES = (
    Cause(
        "dynamics.bias",
        "Dynamics biased",
        (Symptom("dynamics bias/*", 0),),
        f"dynamics error/*|dynamics nis/*|{FILTER}",
        RETRAIN,
        "shift dynamics",
        lowers="lag/dynamics/*",
    ),
    Cause(
        "dynamics.frozen",
        "Dynamics frozen: predicted changes are too small",
        (Symptom("dynamics slope/*|dynamics spread/*", -1),),
        f"dynamics error/*|dynamics nis/*|{FILTER}",
        RETRAIN,
        "scale dynamics",
        lowers="lag/dynamics/*",
    ),
    Cause(
        "dynamics.broken",
        "Dynamics broken",
        (Symptom("dynamics error/*|dynamics bias/*", 0), Symptom("dynamics spread/*|dynamics slope/*", 0)),
        DYNAMICS,
        RETRAIN,
        "restore dynamics",
        lowers="lag/dynamics/*",
        prior=-0.2,
    ),
    Cause(
        "process_noise.small",
        "Process noise too small",
        (Symptom("process noise/*", -1), Symptom("dynamics nis/*", 1)),
        FILTER,
        CALIBRATE,
        "rescale process noise",
    ),
    Cause(
        "process_noise.large",
        "Process noise too large",
        (Symptom("process noise/*", 1), Symptom("dynamics nis/*", -1)),
        FILTER,
        CALIBRATE,
        "rescale process noise",
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

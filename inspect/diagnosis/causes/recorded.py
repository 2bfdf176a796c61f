"""Causes in a filter known by recorded runs only: they show in its estimates, while the readings are healthy."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import FILTER

ERRORS = "error/*|angle error/*|component error/*"

RECORDED = (
    Cause(
        "filter.overconfident",
        "Covariance of the filter too small",
        (Symptom("belief variance/*", -1), Symptom("nees/*", 1, optional=True)),
        FILTER,
        "Compare the process noise and the measurement noises with those of the healthy runs: one is too small.",
    ),
    Cause(
        "filter.underconfident",
        "Covariance of the filter too large",
        (Symptom("belief variance/*", 1), Symptom("nees/*", -1, optional=True)),
        FILTER,
        "Compare the process noise and the measurement noises with those of the healthy runs, and look for readings "
        "that the filter does not use.",
    ),
    Cause(
        "filter.changed",
        "Filter changed while its readings are healthy",
        (Symptom(ERRORS),),
        FILTER,
        "Compare the code and parameters of the filter with those of the healthy runs; as an external filter "
        "(docs/own_filter.md), the fault of its equations is named.",
        prior=-0.1,  # wrong noises change the errors as well
    ),
)

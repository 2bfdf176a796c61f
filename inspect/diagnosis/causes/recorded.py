"""Causes in a filter known by its estimates only: they deviate while the readings are healthy."""

from __future__ import annotations

from dataclasses import replace

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
        "Filter changed, while its readings show no fault",
        (Symptom(ERRORS),),
        FILTER,
        "Compare the code and parameters of the filter with those of the healthy runs; to find a fault of its "
        "equations, diagnose it as an external filter (docs/own_filter.md).",
        prior=-0.3,  # wrong noises and faulty readings change the errors as well
    ),
)
"""Of recorded runs."""

OUTPUT = (
    "Compare the output for the covariance with the version of the healthy record: variance or standard deviation, its "
    "logarithm, its scale."
)

NEXT = {
    "filter.overconfident": OUTPUT,
    "filter.underconfident": OUTPUT,
    "filter.changed": "Compare the code and weights with the version of the healthy record: the normalisation, units "
    "and order of the inputs, and the state that it keeps between steps.",
}
"""Next actions of an external filter that reports estimates only, such as a recurrent network."""

OF_ESTIMATES = tuple(replace(cause, next=NEXT[cause.name]) for cause in RECORDED)
"""Of such a filter."""

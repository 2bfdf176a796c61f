"""Causes in the particle set and its resampling."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Command, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import FILTER

CAUSES = (
    Cause(
        "particles.few",
        "Too few particles",
        (Symptom("particles/*", -1),),
        f"measurement noise/*|process noise/*|dynamics nis/*|dynamics error/*|dynamics bias/*|{FILTER}",
        "Use more particles",
        "healthy particles",
        command=Command("evaluate", "--particles 1000"),
        by_hand="Use more particles in the filter's own code.",
    ),
    Cause(
        "particles.deprived",
        "Particle deprivation: few ancestors survive",
        (Symptom("ancestors/*", -1), Symptom("offspring/*", 1)),
        FILTER,
        "Check the resampling, and increase the process noise.",
        "restore equations",
    ),
    Cause(
        "resampling.off",
        "Resampling off, or wrong weights after it",
        (Symptom("prior ess/*", -1),),
        f"fusion mean/*|fusion variance/*|{FILTER}",
        "Resample at every step, and make all weights equal afterwards; after soft resampling, they are those of the "
        "ancestors divided by the probabilities of the draws.",
        "restore equations",
    ),
    Cause(
        "resampling.biased",
        "Resampling biased: offspring is not proportional to the weights",
        (Symptom("offspring/*", 1), Symptom("ancestors/*", 1, 0.5)),
        FILTER,
        "Check the implementation of the resampling: the choice of the ancestors, and the weights after it.",
        "restore equations",
        lowers="prior ess/*",
    ),
)

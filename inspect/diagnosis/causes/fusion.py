"""Causes in the fusion weights and the fusion rule."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Command, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import FILTER, WEIGHTS

RETRAIN = Command("finetune", train="weights-only")
CORRECT = "Correct them in the filter's own code."

CAUSES = (
    Cause(
        "weights.constant",
        "Fusion weights constant",
        (Symptom("beta spread/*", -1),),
        WEIGHTS,
        "Fine-tune them",
        "healthy beta",
        command=RETRAIN,
        by_hand=CORRECT,
    ),
    Cause(
        "weights.inverted",
        "Fusion weights inverted",
        (Symptom("beta logit/*|beta contact/*", target="mirrored"), Symptom("beta logit/*", 0)),
        WEIGHTS,
        "Fine-tune them",
        "invert beta",
        command=RETRAIN,
        by_hand=CORRECT,
    ),
    Cause(
        "weights.ignores_image",
        "Fusion weights ignore the image",
        (Symptom("beta logit/image*", -1), Symptom("beta logit/*", target="shifted")),
        f"beta spread/*|{FILTER}",
        "Fine-tune them",
        "healthy beta",
        command=RETRAIN,
        by_hand=CORRECT,
    ),
    Cause(
        "weights.ignores_haptics",
        "Fusion weights ignore haptics",
        (Symptom("beta logit/image*", 1), Symptom("beta logit/*", target="shifted")),
        f"beta spread/*|{FILTER}",
        "Fine-tune them",
        "healthy beta",
        command=RETRAIN,
        by_hand=CORRECT,
    ),
    Cause(
        "weights.ignores_likelihood",
        "Particle weights ignore a likelihood",
        (Symptom("likelihood share/*", -1),),
        FILTER,
        "Multiply the particle weights by the likelihood of every measurement model.",
    ),
    Cause(
        "weights.repeats_likelihood",
        "Particle weights count a likelihood more than once",
        (Symptom("likelihood share/*", 1),),
        FILTER,
        "Multiply the particle weights once by the likelihood of every measurement model.",
    ),
    Cause(
        "fusion.shared_prior",
        "Prior counted more than once in the fusion",
        (Symptom("fusion mean/*", 1),),
        f"fusion variance/*|reported variance/*|{FILTER}",
        "Divide the product of the posteriors by their common prior, or use the information filter.",
        "restore equations",
    ),
    Cause(
        "fusion.miscalibrated",
        "Fusion miscalibrated: its covariance does not follow the fusion rule",
        (Symptom("fusion variance/*", 0),),
        f"offspring/*|{FILTER}",
        "Check the implementation of the fusion rule.",
        "restore equations",
    ),
)

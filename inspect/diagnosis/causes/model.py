"""Causes in the measurement models, the same for each modality."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Command, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import FILTER, LABELS


def causes_of(modality: str, title: str, check: str = "", belief: str = FILTER) -> tuple[Cause, ...]:
    """Causes of one modality's measurement model.

    title: start of the headlines. check: what to do before the next action, where faults of the sensors look alike.
    belief: statistics downstream of the model.
    """
    name = f"model.{modality}"
    module = f"*{modality}*"
    retrain, calibrate = Command("finetune", train=f"{modality}-only"), Command("finetune", train="noise-only")
    by_hand = f"{check}Correct it in the filter's own code."
    return (
        Cause(
            f"{name}.bias",
            f"{title} biased",
            (Symptom(f"module bias/{module}", 0), Symptom("module bias/*", 0, 0.3, "alone")),
            "|".join(f"module {kind}/{module}" for kind in ("error", "nis")) + f"|{LABELS}|{belief}",
            f"{check}Fine-tune it",
            f"shift {modality}",
            command=retrain,
            by_hand=by_hand,
            lowers=f"module spread/{module}|module scatter/{module}",
        ),
        Cause(
            f"{name}.overconfident",
            f"{title} overconfident",
            (Symptom(f"module power/{module}", 1),),
            f"module std/{module}|module nis/{module}|{LABELS}|{belief}",
            f"{check}Calibrate it",
            f"rescale {modality}",
            command=calibrate,
            by_hand=by_hand,
        ),
        Cause(
            f"{name}.underconfident",
            f"{title} underconfident",
            (Symptom(f"module power/{module}", -1),),
            f"module std/{module}|module nis/{module}|{LABELS}|{belief}",
            f"{check}Calibrate it",
            f"rescale {modality}",
            command=calibrate,
            by_hand=by_hand,
        ),
        Cause(
            f"{name}.broken",
            f"{title} broken",
            (
                Symptom(f"module error/{module}|module spread/{module}|module scatter/{module}", 0),
                Symptom(f"module power/{module}", 0, 0.5),
            ),
            f"module */{module}|{LABELS}|{belief}",
            f"{check}Fine-tune it",
            f"restore {modality}",
            command=retrain,
            by_hand=by_hand,
        ),
    )


CAUSES = causes_of("image", "Image model") + causes_of("haptics", "Haptics model")

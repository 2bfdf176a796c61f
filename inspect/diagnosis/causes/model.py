"""Causes in the measurement models, the same for each modality."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import FILTER


def causes_of(modality: str) -> tuple[Cause, ...]:
    """Causes of one modality's measurement model."""
    name, title = f"model.{modality}", f"{modality.capitalize()} model"
    module = f"*{modality}*"
    labels = f"lag/labels {module}|offset/labels*"
    retrain = f"Fine-tune it: beliefscope finetune {{task}} --filter {{filter}} --train {modality}-only."
    calibrate = "Calibrate it: beliefscope finetune {task} --filter {filter} --train noise-only."
    return (
        Cause(
            f"{name}.bias",
            f"{title} biased",
            (Symptom(f"module bias/{module}", 0),),
            f"module error/{module}|module nis/{module}|{labels}|module std/{module}|{FILTER}",
            retrain,
            f"shift {modality}",
        ),
        Cause(
            f"{name}.overconfident",
            f"{title} overconfident",
            (Symptom(f"module power/{module}", 1),),
            f"module std/{module}|module nis/{module}|{labels}|{FILTER}",
            calibrate,
            f"rescale {modality}",
        ),
        Cause(
            f"{name}.underconfident",
            f"{title} underconfident",
            (Symptom(f"module power/{module}", -1),),
            f"module std/{module}|module nis/{module}|{labels}|{FILTER}",
            calibrate,
            f"rescale {modality}",
        ),
        Cause(
            f"{name}.broken",
            f"{title} broken",
            (
                Symptom(f"module error/{module}|module spread/{module}|module scatter/{module}", 0),
                Symptom(f"module power/{module}|module spread/{module}|module scatter/{module}", 0, 0.5),
            ),
            f"module */{module}|{labels}|{FILTER}",
            retrain,
            f"restore {modality}",
        ),
    )


CAUSES = causes_of("image") + causes_of("haptics")

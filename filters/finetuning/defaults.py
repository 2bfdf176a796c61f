"""The default fine-tuning of a filter: learn a sensor fault that the training data lack.

docs/finetune.md has its effect on the shipped filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.module_selection import presets
from beliefscope.filters.finetuning.settings import FineTune, StepRange
from beliefscope.filters.finetuning.slices import FAULT_SLICES, fault_slices, parse_slices

RELIABILITY = FineTune(train=("reliability-only",), steps=150, rate=5e-4)

CLEAN_WEIGHT = 0.97
"""Of filters with images. Errors with an occluded image are so much larger than clean ones that they would outweigh
clean data at equal weights."""


def default_settings(filter_: Filter) -> FineTune:
    """Settings chosen on validation episodes, on data with a fault of the filter's first modality (``fault_slices``).

    Without such a fault: the whole filter on clean data.
    """
    for modality, slice_ in fault_slices(filter_.task, filter_.names).items():
        settings = replace(RELIABILITY, mix=((slice_, 1.0),))
        if modality == "image":
            settings = replace(settings, clean_weight=CLEAN_WEIGHT)
        elif filter_.architecture.kind != "pf":
            settings = replace(settings, train=("haptics-only",), rate=FineTune.rate)
        known = set(settings.train) <= set(presets(filter_))
        return settings if known else replace(settings, train=(f"{modality}-only",))
    return FineTune()


def settings_from(
    base: Checkpoint,
    train: Sequence[str] = (),
    freeze: Sequence[str] = (),
    slices: Sequence[str] = (),
    faults: Sequence[str] = (),
    events: Sequence[str] = (),
) -> FineTune:
    """Settings with these modules and data, as texts, or the default ones of the filter if none are given."""
    if not isinstance(base, ExternalFilter) and not any((train, freeze, slices, faults, events)):
        return default_settings(base.filter)
    mix = tuple((slice_, 1.0) for slice_ in parse_slices(slices, faults, base.task))
    return FineTune(tuple(train), tuple(freeze), mix=mix, events=tuple(map(StepRange.parse, events)))


def reason(filter_: Filter) -> str:
    """Why these are the defaults, or that none were found, and what to try then."""
    settings = default_settings(filter_)
    for slice_, _ in settings.mix:
        fault = f"Shipped filters were not trained with the sensor fault \u201c{slice_.name}\u201d"
        crossmodal, kind = filter_.architecture.fusion == "crossmodal", filter_.architecture.kind
        if slice_ == FAULT_SLICES["image"] and kind != "pf" and not crossmodal:
            return (
                f"{fault}. No settings were found that improve this filter there without loss on clean data: compare "
                "the result before you save it, and try other modules or faults."
            )
        return (
            f"{fault}, which multiplies their error; by default, the modules of \u201c{settings.train[0]}\u201d learn "
            "from data with this fault. If this brings no change, try other modules or faults."
        )
    return ""

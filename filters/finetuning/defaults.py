"""The default fine-tuning of a filter: learn a sensor fault that the training data lack.

docs/finetune.md has its effect on the pretrained filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.module_selection import presets
from beliefscope.filters.finetuning.settings import FineTune, StepRange, parse_rates
from beliefscope.filters.finetuning.slices import FAULT_SLICES, NOISY_IMAGES, fault_slices, parse_slices

RELIABILITY = FineTune(train=("reliability-only",), steps=150, rate=5e-4)

CLEAN_WEIGHT = 0.97
"""Of filters with images. Errors with faulty images are so much larger than clean ones that they would outweigh clean
data at equal weights."""


def default_settings(filter_: Filter) -> FineTune:
    """Settings chosen on validation episodes, on data with a fault of the filter's sensors (``fault_slices``).

    Without such a fault: the whole filter on clean data.
    """
    offered = fault_slices(filter_.task, filter_.names)
    if not offered:
        return FineTune()
    slice_ = offered[0]
    modality = FAULT_SLICES[slice_]
    architecture = filter_.architecture
    settings = RELIABILITY
    # Particle filters, and filters with a weight model, can learn to distrust an image. Others must learn to read it.
    distrusts = architecture.kind == "pf" or (modality == "image" and architecture.fusion == "crossmodal")
    if not distrusts or "reliability-only" not in presets(filter_):
        settings = replace(settings, train=(f"{modality}-only",), rate=FineTune.rate)
        if modality == "image":
            slice_ = NOISY_IMAGES
    if modality == "image":
        settings = replace(settings, clean_weight=CLEAN_WEIGHT)
    return replace(settings, mix=((slice_, 1.0),))


def settings_from(
    base: Checkpoint,
    train: Sequence[str] | None = None,
    freeze: Sequence[str] | None = None,
    slices: Sequence[str] | None = None,
    faults: Sequence[str] | None = None,
    events: Sequence[str] | None = None,
    rates: Sequence[str] | None = None,
    **values: Any,
) -> FineTune:
    """Settings with these modules, data and learning rates, as texts.

    Without modules and data: the default settings of the filter. values: other settings; None keeps the default.
    """
    if not isinstance(base, ExternalFilter) and not any((train, freeze, slices, faults, events)):
        settings = default_settings(base.filter)
    else:
        mix = tuple((slice_, 1.0) for slice_ in parse_slices(slices or (), faults or (), base.task))
        steps = tuple(map(StepRange.parse, events or ()))
        settings = FineTune(tuple(train or ()), tuple(freeze or ()), mix=mix, events=steps)
    rate, own_rates = parse_rates(rates or ())
    values = {name: value for name, value in values.items() if value is not None}
    return replace(settings, rate=rate, rates=own_rates, **values)


def reason(filter_: Filter) -> str:
    """Why these are the defaults, and what to try if they have no effect."""
    settings = default_settings(filter_)
    if not settings.mix:
        return ""
    ((slice_, _),) = settings.mix
    modules = settings.train[0].replace("-", " ")
    return (
        f"The sensor fault \u201c{slice_.name}\u201d increases the error of the pretrained filters. The default trains "
        f"the modules of \u201c{modules}\u201d on data with this fault. "
        "If the run ends without a change, try other modules or faults."
    )

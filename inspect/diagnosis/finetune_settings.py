"""Fine-tuning settings for a weakness of a filter: the modules of the probable cause, and data that show it."""

from __future__ import annotations

from dataclasses import replace

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.defaults import RELIABILITY
from beliefscope.filters.finetuning.module_selection import presets
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import CLEAN, Slice, fault_slice
from beliefscope.filters.finetuning.success import Criterion
from beliefscope.inspect.diagnosis.catalog import causes_of

SENSOR_FAULTS = {
    "image.blackout": "blackout=0.8",
    "image.frozen": "image_frozen=20",
    "image.delay": "delay=image:steps=5",
    "image.shift": "image_shift=3",
    "image.noise": "image_noise=40",
    "image.exposure": "image_underexposed=0.4",
    "image.occlusion": "image_occluded=12",
    "image.blur": "image_blur=1.5",
    "force.bias": "force_bias=5",
    "force.drift": "force_drift=1",
    "force.noise": "force_noise=5",
    "force.saturation": "force_saturation=2",
    "torque.noise": "torque_noise=0.1",
    "effector.noise": "effector_noise=0.005",
    "contact.inverted": "contact_inverted=0.3",
    "contact.delay": "contact_delayed=5",
    "haptics.dropout": "drop=haptics:from=20",
    "haptics.delay": "delay=haptics:steps=5",
}
"""Cause -> the sensor fault that a filter can learn to expect. Others, such as exchanged axes, must be repaired."""

OTHER_PRESETS = {"data.shift": "reliability-only"}
"""Cause -> preset, for causes whose command (``Cause.command``) names none."""

CLEAN_SHARE = 0.8
"""Weight of clean data with a sensor fault. At equal weights, pretrained information filters lose accuracy on them."""


def training_for(cause: str, filter_: Filter, faults: Faults = NO_FAULTS) -> FineTune | None:
    """Settings that address a cause of ``inspect/diagnosis/catalog.py``; None for one that no training removes.

    Args:
        faults: injected into the run. A sensor fault among them is learned in place of a standard one.
    """
    component, _, mechanism = cause.rpartition(".")
    if cause in SENSOR_FAULTS:
        injected = faults or Faults.parse(SENSOR_FAULTS[cause])
        return training_on(fault_slice(injected), filter_)
    command = next((known.command for known in causes_of(filter_.task) if known.name == cause), None)
    preset = OTHER_PRESETS.get(cause) or (command and command.train)
    if not preset:
        return None
    modality = component.removeprefix("model.")
    is_model = modality != component and len(filter_.names) > 1
    slice_ = Slice(f"{modality} only", only=(modality,)) if is_model else CLEAN
    measure = "nees" if mechanism in ("overconfident", "underconfident", "small", "large") else "error"
    mix = () if slice_ == CLEAN else ((slice_, 1.0),)
    settings = FineTune(train=(preset,), steps=150, mix=mix)
    return _available(replace(settings, success=Criterion(slice_.name, measure)), filter_)


def training_on(slice_: Slice, filter_: Filter) -> FineTune | None:
    """Settings that learn how far to trust each sensor in a slice; None if the slice does not fit the filter."""
    try:
        slice_.check(filter_.task, filter_.names)
    except BadInput:
        return None
    settings = replace(RELIABILITY, mix=((slice_, 1.0),), clean_weight=CLEAN_SHARE)
    return _available(replace(settings, success=Criterion(slice_.name)), filter_)


def _available(settings: FineTune, filter_: Filter) -> FineTune:
    """The settings with a preset that the filter has."""
    names = presets(filter_)
    for name in (*settings.train, "reliability-only", "noise-only"):
        if name in names:
            return replace(settings, train=(name,))
    return replace(settings, train=("all",))

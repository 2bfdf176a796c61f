"""Whether an external filter without innovations uses its readings: steps from true states, with readings of others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from beliefscope.datasets.episode import is_image, lost_images
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.checks.true_starts import (
    LARGEST_STD,
    LEAST_STEPS,
    has_true_starts,
    run_from_truth,
    smallest_std,
    some_steps,
)
from beliefscope.inspect.statistics.innovations import AnyArray
from beliefscope.inspect.statistics.signals import Mask
from beliefscope.inspect.trace import Trace

LATER = 5
"""Steps to the reading that replaces another one: far enough for another state."""


def used_readings(trace: Trace, checkpoint: ExternalFilter) -> dict[str, float]:
    """``updates/MODALITY/all``: share of the steps with a reading whose estimate changes with another reading.

    ``absent updates/MODALITY/all``: the same of the steps without a reading. The other reading is the one of ``LATER``
    steps later. Steps at which both are equal, or an image is lost, do not count. An update that is left out changes
    nothing: both runs have the same start and seed, and their results are equal to the last bit. The belief at the
    start is wide enough for an update to change it.

    Of filters that report neither innovations nor likelihoods, which show their updates, and can start at a belief.
    """
    if trace.innovation is not None or trace.log_likelihood is not None or not has_true_starts(checkpoint):
        return {}
    steps = some_steps(trace, checkpoint)
    std = np.maximum(LARGEST_STD * trace.episode.states.astype(np.float64).std(0), smallest_std(trace))
    own = run_from_truth(trace, checkpoint, steps, std) if len(steps) else None
    values: dict[str, float] = {}
    if own is None:
        return values
    for modality, keys in trace.task.modalities.items():
        other, differs = _later(trace, keys)
        present = np.logical_or.reduce([np.zeros(len(trace), bool), *(trace.episode.present(key) for key in keys)])
        with_reading, without = (differs & at for at in (present, ~present))
        if max(with_reading[steps].sum(), without[steps].sum()) < LEAST_STEPS:
            continue
        changed = run_from_truth(other, checkpoint, steps, std)
        if changed is None:
            continue
        moved = _differ(own, changed)
        for kind, at in (("updates", with_reading), ("absent updates", without)):
            if at[steps].sum() >= LEAST_STEPS:
                values[f"{kind}/{modality}/all"] = float(moved[at[steps]].mean())
    return values


def _later(trace: Trace, keys: Sequence[str]) -> tuple[Trace, Mask]:
    """The trace with the readings of some sensors of other steps, and the steps (T,) at which they differ."""
    steps = np.arange(len(trace))
    source = np.where(steps + LATER < len(trace), steps + LATER, np.maximum(steps - LATER, 0))
    readings, differs, seen = dict(trace.episode.observations), np.zeros(len(trace), bool), np.ones(len(trace), bool)
    for key in keys:
        own = readings[key]
        readings[key] = own[source]
        lost = lost_images(own) if is_image(own) else np.zeros(len(own), bool)
        differs |= (own != readings[key]).reshape(len(own), -1).any(1)
        seen &= ~lost & ~lost[source]
    return replace(trace, episode=replace(trace.episode, observations=readings)), differs & seen


def _differ(own: dict[str, AnyArray], changed: dict[str, AnyArray]) -> Mask:
    """(S,): whether the mean or the covariance of the estimate differs."""
    names = [name for name in ("estimate_mean", "estimate_covariance") if name in own and name in changed]
    pairs = ((own[name], changed[name]) for name in names)
    return np.logical_or.reduce([(a != b).reshape(len(a), -1).any(1) for a, b in pairs])

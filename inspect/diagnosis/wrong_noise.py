"""Process and measurement noise of an external filter that contradict its errors, also in its healthy record.

The comparison with the record shows nothing if the filter has always been overconfident. Correct noise needs no record:
squared errors of the predictions are about Q, and squared innovations about S.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beliefscope.datasets.task import display_name
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.checks.true_starts import has_true_starts
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile

SMALLEST = 3.0
"""Smallest ratio of squared errors to their variance of a noise that is too small."""

NAMED = 2
"""Largest number of named components or modalities."""


class WrongNoise(NamedTuple):
    """finding, action: texts without an end."""

    finding: str
    action: str


def too_small(profile: HealthyProfile, checkpoint: Checkpoint) -> WrongNoise | None:
    """The noise that makes a filter overconfident; None if none stands out.

    Squared innovations are also too large if the process noise is too small, so the latter is named first. Only of
    filters whose predictions are examined from true states: errors of the estimates are not those of the dynamics.
    """
    if not isinstance(checkpoint, ExternalFilter) or not has_true_starts(checkpoint):
        return None
    if components := _too_large(profile, "dynamics nis"):
        listed = ", ".join(f"{display_name(name)}: {ratio:.{_digits(ratio)}f} times Q" for name, ratio in components)
        finding = f"its process noise is too small for the squared errors of its dynamics ({listed})"
        return WrongNoise(finding, "compare Q with the errors of the predictions, and check the dynamics")
    if modalities := _too_large(profile, "nis"):
        listed = ", ".join(f"{display_name(name)}: NIS/m {ratio:.{_digits(ratio)}f}" for name, ratio in modalities)
        finding = f"its measurement noise is too small for its innovations ({listed})"
        return WrongNoise(finding, "compare R with the variance of the readings, and check the measurement functions")
    return None


def _too_large(profile: HealthyProfile, kind: str) -> list[tuple[str, float]]:
    """Subjects of a kind with their median over the episodes, largest first."""
    medians = {
        name.split("/")[1]: float(np.nanmedian(values))
        for name, values in profile.statistics.items()
        if name.startswith(f"{kind}/") and name.endswith("/all") and np.isfinite(values).any()
    }
    large = [(name, ratio) for name, ratio in medians.items() if ratio > SMALLEST]
    return sorted(large, key=lambda item: -item[1])[:NAMED]


def _digits(ratio: float) -> int:
    return 1 if ratio < 10.0 else 0

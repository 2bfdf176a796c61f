"""Consistency of one estimate in one phase, and its assessment."""

from __future__ import annotations

import math
from dataclasses import dataclass

from beliefscope.inspect.statistics.intervals import too_few
from beliefscope.inspect.statistics.measures import MIN_STEPS, Array

CONSISTENT = "consistent"


@dataclass(frozen=True)
class LayerConsistency:
    """Consistency of one layer in one phase.

    Attributes:
        layer: ``fused``, or the modality of a single-modality update.
        phase: phase name.
        trajectories, steps: number of episodes and steps in the phase.
        nees: mean of ``e^T S^-1 e / n``.
        interval: 95 % interval of ``nees`` over episodes; NaN for too few of them, unless ``nees`` is too large for any
            number of steps of a consistent filter (``nees_limit``): then only its lower limit is known.
        adjusted: the same, simultaneous over all layers and phases (Bonferroni).
        nis: mean of the normalised innovation squared over n; NaN without innovations.
        coverage95: share of steps with the true state in the 95 % region.
        calibration: (P,) share of steps with the true state in the region of each of ``LEVELS``.
        miscalibration: mean absolute difference between ``calibration`` and ``LEVELS``.
        nll: mean negative log density of the true state, nats in m and rad.
        rmse, sharpness, crps: (n,) m, rad: root mean square error, root mean predicted variance, mean CRPS.
    """

    layer: str
    phase: str
    trajectories: int
    steps: int
    nees: float
    interval: tuple[float, float]
    adjusted: tuple[float, float]
    nis: float
    coverage95: float
    calibration: Array
    miscalibration: float
    nll: float
    rmse: Array
    sharpness: Array
    crps: Array

    @property
    def factor(self) -> float:
        """Factor by which predicted standard deviations are too small; below 1 if too large."""
        return math.sqrt(self.nees)

    @property
    def refusal(self) -> str | None:
        """Why there is no assessment, or None."""
        if self.steps < MIN_STEPS:
            return f"too few steps ({self.steps}; at least {MIN_STEPS} needed)"
        return too_few(self.trajectories) if math.isnan(self.interval[0]) else None

    @property
    def assessment(self) -> str:
        """``consistent`` if 1 is in the interval, otherwise over- or underconfident with the factor, or why unknown."""
        return self.refusal or self._assess(self.interval)

    @property
    def inconsistent(self) -> bool:
        """Whether 1 is outside of the simultaneous interval."""
        return self.refusal is None and self._assess(self.adjusted) != CONSISTENT

    def _assess(self, interval: tuple[float, float]) -> str:
        low, high = interval
        if low > 1.0:
            return f"overconfident by a factor of {number(self.factor)}"
        return f"underconfident by a factor of {number(1.0 / self.factor)}" if high < 1.0 else CONSISTENT

    @property
    def evidence(self) -> str:
        """NEES / n and its interval."""
        low, high = self.interval
        text = f"NEES/n {number(self.nees)}"
        if math.isinf(high):
            return f"{text}, with 95 % confidence at least {number(low)}"
        return text if math.isnan(low) else f"{text}, 95 % interval {number(low)} to {number(high)}"


def inconsistency(entry: LayerConsistency) -> float:
    """Absolute logarithm of NEES / n."""
    return abs(math.log(entry.nees)) if entry.nees > 0 else math.inf


def number(value: float) -> str:
    return f"{value:.0f}" if 10 <= value < 1e6 else f"{value:.2g}"

"""Noise of vector sensors around their expected readings, which motion and gaps do not change."""

from __future__ import annotations

import numpy as np

from beliefscope.datasets.task import axis_name
from beliefscope.inspect.diagnosis.checks.windows import LENGTH, MIN_WINDOWS, window_starts
from beliefscope.inspect.diagnostics.statistic_kinds import EXPECTED, EXPECTED_EXTREME
from beliefscope.inspect.statistics.reading_model import ComparedReadings
from beliefscope.inspect.statistics.signals import Array, Mask, noise_level


def noise_around_expected(compared: ComparedReadings, delay: int, count: int) -> dict[str, float]:
    """``noise`` of the errors of each expected channel, in the whole episode and in its noisiest window.

    Args:
        delay: of the readings behind the expected ones, steps. count: channels of the sensor.
    """
    errors, fresh = delayed(compared, delay)
    parts = [slice(first, first + LENGTH) for first in window_starts(len(errors))]
    windows = np.array([noise_level(errors[part], fresh[part]) for part in parts]).reshape(-1, errors.shape[1])
    noise, values = noise_level(errors, fresh), {}
    for i, channel in enumerate(compared.model.channels):
        axis, finite = axis_name(compared.model.key, channel, count), windows[np.isfinite(windows[:, i]), i]
        values[f"noise/{axis}/{EXPECTED}"] = float(noise[i])
        values[f"noise/{axis}/{EXPECTED_EXTREME}"] = float(finite.max()) if len(finite) >= MIN_WINDOWS else np.nan
    return values


def delayed(compared: ComparedReadings, delay: int) -> tuple[Array, Mask]:
    """Errors (T, A) against the readings expected ``delay`` steps earlier, and the steps (T,) with new readings.

    Other steps have an error of 0.
    """
    errors, known = np.zeros(compared.measured.shape), np.zeros(len(compared.measured), dtype=bool)
    steps = compared.steps(delay)
    errors[steps] = np.subtract(*compared.pairs(delay))
    known[steps] = True
    return errors, known & compared.fresh

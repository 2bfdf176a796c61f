"""Calibration of a Gaussian filter: one factor on its noise, which leaves the estimates nearly unchanged."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import nn

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.ekf import ExtendedKalmanFilter, VirtualSensor
from beliefscope.filters.models.information import InformationFilter

ROUNDS = 3
"""Scalings: a single one is not exact, because the covariance of the first belief is fixed."""


def noise_parameters(filter_: Filter) -> list[nn.Parameter]:
    """The log standard deviations of the process noise, and the biases of those of all virtual sensors.

    An information filter has its scales of R and sensor biases instead of the latter: its sensors are frozen.

    Raises BadInput for a filter without virtual sensors.
    """
    if not isinstance(filter_, ExtendedKalmanFilter):
        raise BadInput(f"--calibrate applies to ekf and ukf filters, not to {filter_.architecture.kind}")
    if isinstance(filter_, InformationFilter):
        return [filter_.dynamics.log_noise, filter_.log_motion, filter_.log_scale, filter_.log_bias]
    sensors = [module for module in filter_.virtual_sensors.values() if isinstance(module, VirtualSensor)]
    return [filter_.dynamics.log_noise, *(sensor.log_noise[-1].get_parameter("bias") for sensor in sensors)]


@torch.no_grad()
def calibrate_noise(filter_: Filter, nees: Callable[[], float]) -> float:
    """Scales process and measurement noise by one factor such that ``nees`` is 1; returns the factor.

    Multiplying Q and R by c^2 leaves the Kalman gain unchanged and multiplies the posterior covariance by c^2, once the
    first belief is forgotten. Correlated errors, which no white noise model represents, are covered on average.

    Args:
        nees: mean NEES / n of the filter as it is.
    """
    parameters, total = noise_parameters(filter_), 1.0
    for _ in range(ROUNDS):
        factor = math.sqrt(nees())
        for parameter in parameters:
            parameter.add_(math.log(factor))
        total *= factor
    return total

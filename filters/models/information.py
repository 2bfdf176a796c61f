"""Extended Kalman filter with one prior for all modalities, calibrated sensors and an update in information form."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from beliefscope.filters.batch import Batch, position_channels
from beliefscope.filters.belief import Belief, Evidence, Gaussian, StepTrace
from beliefscope.filters.filter import Architecture
from beliefscope.filters.models.ekf import ExtendedKalmanFilter, VirtualSensor
from beliefscope.filters.models.fusion import powers, weighted_product

HISTORY = 5
"""Past steps that virtual sensors of vectors see, besides the current one."""


def recent_steps(values: Tensor, steps: int, relative: list[int]) -> Tensor:
    """Each step's readings (T, N, d) with those of past steps, newest first: (T, N, (steps + 1) d).

    Past steps before the first repeat it.

    Args:
        relative: channels given relative to the current step.
    """
    time = torch.arange(len(values), device=values.device)
    window = values[
        (time[:, None] - torch.arange(steps + 1, device=values.device)).clamp_min(0)
    ]  # (T, steps + 1, N, d)
    origin = torch.zeros_like(values)
    origin[..., relative] = values[..., relative]
    return (window - origin.unsqueeze(1)).transpose(1, 2).flatten(2)


class InformationFilter(ExtendedKalmanFilter):
    """Precisions add: ``P^-1 = P'^-1 + sum_k p_k R_k^-1``, ``m = m' + P sum_k p_k R_k^-1 (z_k - m')``.

    ``m'``, ``P'`` is the prediction from the fused belief, used once. The powers are ``p_k = K beta_k``; equal weights
    give the Kalman filter with stacked measurements. Virtual sensors are trained by their likelihood and then frozen;
    a scale of each R, beta and the dynamics train end to end. Sensors of vectors see ``HISTORY`` past steps, and
    observe the object's position relative to the end effector. Static components do not move.
    """

    history = HISTORY

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        vectors = [name for name in self.names if len(self.task.observations[self.task.modalities[name][0]]) == 1]
        for name in vectors:
            self.virtual_sensors[name] = VirtualSensor(self.task, name, architecture, 1 + HISTORY)
        self.log_scale = nn.Parameter(torch.zeros(len(self.names), self.n))
        self.dynamics.static = tuple(i for i, component in enumerate(self.task.components) if component.static)

    def sense(self, name: str, observations: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """z and the square root of R's diagonal of one virtual sensor, (T, N, n), standardised, without ``log_scale``.

        Args:
            observations: standardised, of consecutive steps.
        """
        sensor, values = self.virtual_sensors[name], observations[name]
        if values.ndim != 3 or values.dtype == torch.int64:
            return sensor(observations)
        channels = position_channels(self.task, name)
        flat = [channel for pair in channels for channel in pair]
        z, noise = sensor({name: recent_steps(values, HISTORY, flat)})
        if not channels:
            return z, noise
        (mean, std), (state_mean, state_std) = (self.statistics.mean_std(key) for key in (name, "state"))
        x_y, on_map = channels[0], list(self.task.map_indices)
        hand = (values[..., x_y] * std[x_y] + mean[x_y] - state_mean[on_map]) / state_std[on_map]
        return z.index_add(-1, torch.tensor(on_map, device=z.device), hand), noise

    def encode(self, batch: Batch) -> Evidence:
        observations = self.observations(batch)
        z, noise = zip(*(self.sense(name, observations) for name in self.names), strict=True)
        return Evidence(
            control=self.dynamics.control_part(self.statistics.standardise("control", batch.controls)),
            observation=torch.stack(z, dim=2),
            noise=torch.stack(noise, dim=2) * self.log_scale.exp(),
            log_weights=self.log_weights(batch),
        )

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Gaussian, StepTrace]:
        assert evidence.noise is not None
        assert evidence.log_weights is not None
        predicted, bank = self.predict_and_update(belief, evidence)
        sensors = torch.diag_embed(evidence.noise**2)
        power = powers(evidence.log_weights, evidence.present)
        experts = Gaussian(
            torch.cat([predicted.mean[:, :1], evidence.observation], dim=1),
            torch.cat([predicted.covariance[:, :1], sensors], dim=1),
        )
        fused = weighted_product(experts, torch.cat([torch.ones_like(power[:, :1]), power], dim=1))
        return self.bank_of(fused), StepTrace(predicted, posterior=fused, estimate=fused, modality=bank)

    def fuse(self, bank: Gaussian, log_weights: Tensor | None, present: Tensor | None = None) -> Gaussian:
        """The product of a bank (N, K, n), without a prior."""
        assert log_weights is not None
        return weighted_product(bank, powers(log_weights, present))

    def shares(self, evidence: Evidence) -> Tensor:
        """Information share: ``p_k R_k^-1`` of each component, normalised over the models, (T, N, K, n)."""
        assert evidence.noise is not None
        assert evidence.log_weights is not None
        return torch.softmax(evidence.log_weights - 2.0 * evidence.noise.log(), dim=-2)

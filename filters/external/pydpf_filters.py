"""Filters of PyDPF (https://github.com/John-JoB/pydpf) as external filters, through its aggregation functions.

PyDPF calls an aggregation function after every step with states, normalised log weights and the log-likelihood of the
step; the one of this adapter keeps them. PyDPF itself (GPL 3) is neither imported nor copied here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn


class _Keep(nn.Module):
    """Aggregation function: keeps particles and log weights of every step; returns the weighted mean."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[tuple[Tensor, Tensor, Tensor]] = []

    def forward(self, *, state: Tensor, weight: Tensor, likelihood: Tensor, **data: Any) -> Tensor:
        self.steps.append((state, weight, likelihood))
        return (weight.exp().unsqueeze(-1) * state).sum(1)


class PyDPF(nn.Module):
    """A PyDPF filter (``SIS`` or a subclass); use with ``Adapter(PyDPF(...))``.

    It draws its initial particles from its own prior, and processes all steps at once.
    """

    def __init__(
        self,
        filter_: Any,
        observation: Callable[[Mapping[str, Tensor]], Tensor],
        particles: int,
        control: bool = False,
    ) -> None:
        """observation: observations by key, (T, N, ...) -> the filter's, (T, N, d).

        Args:
            control: whether the filter takes the controls.
        """
        super().__init__()
        self.filter: Any = filter_
        self.particles = particles
        self._observation, self._control = observation, control

    def forward(self, observations: Mapping[str, Tensor], controls: Tensor) -> dict[str, Any]:
        """Values of all T steps (docs/own_filter.md): particles and their posterior weights before resampling.

        Raises ValueError if the filter stops before the last step.
        """
        kept, inputs = _Keep(), self._observation(observations)
        self.filter(
            n_particles=self.particles,
            time_extent=len(controls) - 1,
            aggregation_function=kept,
            observation=inputs,
            control=controls if self._control else None,
        )
        self.filter.aggregation_function = None
        if len(kept.steps) < len(controls):
            raise ValueError(f"the weights diverge at step {len(kept.steps)}")
        state, weight, likelihood = (torch.stack(parts) for parts in zip(*kept.steps, strict=True))
        return {
            "estimate_mean": (weight.exp().unsqueeze(-1) * state).sum(2),
            "particles": state,
            "log_weights": weight,
            "extra": {"log_evidence": likelihood.reshape(likelihood.shape[:2])},
        }

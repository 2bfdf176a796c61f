"""Base class of the unstructured baselines: networks from all observations and controls so far to the state."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence, Gaussian, Recurrent, StepTrace
from beliefscope.filters.filter import Architecture, Filter, encoders
from beliefscope.filters.models.networks import Residual, Stack, vector_stack


class SequenceModel(Filter):
    """Encoders of all modalities and of the controls, shared layers, a memory, a state readout.

    It has no prediction step and no covariance. Its first memory is a learned function of the first belief's mean, so
    that it starts from the same belief as the other filters.
    """

    has_covariance = False
    output: Stack

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        units = architecture.units
        self.features = self.n + len(self.angles.indices)
        self.encoders = encoders(self.task, self.task.modalities, architecture)
        self.control_encoder = vector_stack(self.task.control_size, units)
        self.shared = Stack(nn.Linear(self.encoders.size + units, units), nn.ReLU(inplace=True), Residual(units))

    def readout(self, size: int) -> Stack:
        """A new network from the memory's output (..., size) to the state (..., n)."""
        units = self.architecture.units
        return Stack(nn.Linear(size, units), nn.ReLU(inplace=True), nn.Linear(units, self.features))

    def encode(self, batch: Batch) -> Evidence:
        control = self.control_encoder(self.statistics.standardise("control", batch.controls))
        joined = torch.cat([self.encoders(self.observations(batch)), control], dim=-1)
        return Evidence(control=control, observation=self.shared(joined).unsqueeze(2), noise=None, log_weights=None)

    def read(self, before: Recurrent, memory: Tensor, output: Tensor) -> tuple[Recurrent, StepTrace]:
        """The belief, and the step's trace, from the new memory (N, L, S, H) and its output (N, H)."""
        after = Recurrent(memory, self.angles.states(self.output(output)))
        unknown = torch.full((*after.mean.shape, self.n), torch.nan, device=after.mean.device)
        return after, StepTrace(predicted=before, posterior=after, estimate=Gaussian(after.mean, unknown))

"""The unstructured baseline: an LSTM from observations and controls to the state."""

from __future__ import annotations

import torch
from torch import nn

from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Belief, Evidence, Gaussian, Recurrent, StepTrace
from beliefscope.filters.filter import Architecture, Filter, encoders
from beliefscope.filters.networks import Residual, Stack, vector_stack

HIDDEN = 512
LAYERS = 2


class Lstm(Filter):
    """Encoders of all modalities and of the controls, shared layers, two LSTM layers of 512, a readout of the state.

    It predicts nothing and knows no covariance. Its first hidden state is a learned function of the first belief's
    mean, so that it starts where the other filters start.
    """

    has_covariance = False

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        units = architecture.units
        self.encoders = encoders(self.task, self.task.modalities, architecture)
        self.control_encoder = vector_stack(self.task.control_size, units)
        self.shared = Stack(nn.Linear(self.encoders.size + units, units), nn.ReLU(), Residual(units))
        self.layers = nn.ModuleList(nn.LSTMCell(units if i == 0 else HIDDEN, HIDDEN) for i in range(LAYERS))
        self.output = Stack(nn.Linear(HIDDEN, units), nn.ReLU(), nn.Linear(units, self.n))
        self.initial = nn.Linear(self.n, LAYERS * 2 * HIDDEN)

    def encode(self, batch: Batch) -> Evidence:
        control = self.control_encoder(self.statistics.standardise("control", batch.controls))
        joined = torch.cat([self.encoders(self.observations(batch)), control], dim=-1)
        return Evidence(control=control, observation=self.shared(joined).unsqueeze(2), noise=None, log_weights=None)

    def start(self, belief: Gaussian, particles: int, generator: torch.Generator) -> Recurrent:
        return Recurrent(self.initial(belief.mean).unflatten(-1, (LAYERS, 2, HIDDEN)).tanh(), belief.mean)

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Recurrent, StepTrace]:
        assert isinstance(belief, Recurrent)
        x, hidden = evidence.observation.squeeze(1), []
        for layer, before in zip(self.layers, belief.hidden.unbind(1), strict=True):
            x, cell = layer(x, before.unbind(1))
            hidden.append(torch.stack([x, cell], dim=1))
        after = Recurrent(torch.stack(hidden, dim=1), self.output(x))
        unknown = torch.full((*after.mean.shape, self.n), torch.nan, device=x.device)
        return after, StepTrace(predicted=belief, posterior=after, estimate=Gaussian(after.mean, unknown))

"""The unstructured baseline: an LSTM from observations and controls to the state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Belief, Evidence, Gaussian, Recurrent, StepTrace
from beliefscope.filters.filter import Architecture, Filter, encoders
from beliefscope.filters.models.networks import Residual, Stack, vector_stack

HIDDEN = 512
LAYERS = 2


class Cell(nn.Module):
    """One LSTM layer: ``c' = s(f) c + s(i) tanh(g)``, ``h' = s(o) tanh(c')``, ``(i, f, g, o) = x Wx + h Wh + b``.

    Weight matrices have inputs along the rows, unlike PyTorch's, which is a quarter faster for one trajectory.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.weight_x = nn.Parameter(torch.empty(inputs, 4 * HIDDEN))
        self.weight_h = nn.Parameter(torch.empty(HIDDEN, 4 * HIDDEN))
        self.bias = nn.Parameter(torch.empty(4 * HIDDEN))
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -(HIDDEN**-0.5), HIDDEN**-0.5)

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        """Inputs (N, d) and hidden state (N, 2, H), output and cell, to the next hidden state (N, 2, H)."""
        before, cell = hidden.unbind(1)
        gates = torch.addmm(torch.addmm(self.bias, x, self.weight_x), before, self.weight_h)
        enter, keep, value, leave = gates.chunk(4, dim=1)
        cell = torch.sigmoid(keep) * cell + torch.sigmoid(enter) * torch.tanh(value)
        return torch.stack([torch.sigmoid(leave) * torch.tanh(cell), cell], dim=1)


class Lstm(Filter):
    """Encoders of all modalities and of the controls, shared layers, two LSTM layers of 512 units, a state readout.

    It has no prediction step and no covariance. Its first hidden state is a learned function of the first belief's
    mean, so that it starts from the same belief as the other filters.
    """

    has_covariance = False

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        units = architecture.units
        self.encoders = encoders(self.task, self.task.modalities, architecture)
        self.control_encoder = vector_stack(self.task.control_size, units)
        self.shared = Stack(nn.Linear(self.encoders.size + units, units), nn.ReLU(inplace=True), Residual(units))
        self.layers = nn.ModuleList(Cell(units if i == 0 else HIDDEN) for i in range(LAYERS))
        self.output = Stack(nn.Linear(HIDDEN, units), nn.ReLU(inplace=True), nn.Linear(units, self.n))
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
            hidden.append(layer(x, before))
            x = hidden[-1][:, 0]
        return self.read(belief, hidden)

    def steps(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> Iterator[StepTrace]:
        """All steps, layer by layer: identical results, but each layer's weights stay in the CPU cache."""
        assert isinstance(belief, Recurrent)
        inputs, hidden = evidence.observation.squeeze(2).unbind(0), []
        for layer, state in zip(self.layers, belief.hidden.unbind(1), strict=True):
            states = []
            for x in inputs:
                state = layer(x, state)
                states.append(state)
            inputs = tuple(state[:, 0] for state in states)
            hidden.append(states)
        for layers in zip(*hidden, strict=True):
            belief, trace = self.read(belief, layers)
            yield trace

    def read(self, before: Recurrent, hidden: Sequence[Tensor]) -> tuple[Recurrent, StepTrace]:
        """The belief, and the step's trace, from each layer's new hidden state (N, 2, H)."""
        after = Recurrent(torch.stack(list(hidden), dim=1), self.output(hidden[-1][:, 0]))
        unknown = torch.full((*after.mean.shape, self.n), torch.nan, device=after.mean.device)
        return after, StepTrace(predicted=before, posterior=after, estimate=Gaussian(after.mean, unknown))

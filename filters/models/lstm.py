"""An LSTM from observations and controls to the state."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from beliefscope.filters.belief import Belief, Evidence, Gaussian, Recurrent, StepTrace
from beliefscope.filters.filter import Architecture
from beliefscope.filters.models.sequence import SequenceModel

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


class Lstm(SequenceModel):
    """Two LSTM layers of 512 units. Its memory is the output and cell of each layer."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        self.layers = nn.ModuleList(Cell(architecture.units if i == 0 else HIDDEN) for i in range(LAYERS))
        self.output = self.readout(HIDDEN)
        self.initial = nn.Linear(self.features, LAYERS * 2 * HIDDEN)

    def start(self, belief: Gaussian, particles: int, generator: torch.Generator) -> Recurrent:
        hidden = self.initial(self.angles.features(belief.mean)).unflatten(-1, (LAYERS, 2, HIDDEN))
        return Recurrent(hidden.tanh(), belief.mean)

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Recurrent, StepTrace]:
        assert isinstance(belief, Recurrent)
        x, hidden = evidence.observation.squeeze(1), []
        for layer, before in zip(self.layers, belief.hidden.unbind(1), strict=True):
            hidden.append(layer(x, before))
            x = hidden[-1][:, 0]
        return self.read(belief, torch.stack(hidden, dim=1), x)

    def steps(
        self, belief: Belief, evidence: Evidence, generator: torch.Generator
    ) -> Iterator[tuple[Belief, StepTrace]]:
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
        for output, *layers in zip(inputs, *hidden, strict=True):
            belief, trace = self.read(belief, torch.stack(layers, dim=1), output)
            yield belief, trace

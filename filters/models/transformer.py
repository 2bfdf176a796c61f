"""A transformer with causal attention over a window of steps, from observations and controls to the state."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from beliefscope.filters.belief import Belief, Evidence, Gaussian, Recurrent, StepTrace
from beliefscope.filters.filter import Architecture
from beliefscope.filters.models.sequence import SequenceModel

WINDOW = 64
"""Steps that a layer attends to, the current one included."""

HEADS = 4
LAYERS = 2


class Attention(nn.Module):
    """A layer before normalisation: ``y = x + A(norm(x), norm(window))``, ``y + W2 relu(W1 norm(y))``.

    Scores have a learned bias for each head and age of a step, which replaces positional encodings, so that results do
    not depend on where in an episode a window begins.
    """

    def __init__(self, units: int) -> None:
        super().__init__()
        self.norm, self.norm_wide = nn.LayerNorm(units), nn.LayerNorm(units)
        self.query, self.key_value = nn.Linear(units, units), nn.Linear(units, 2 * units)
        self.out = nn.Linear(units, units)
        self.age = nn.Parameter(torch.zeros(HEADS, WINDOW))
        self.wide = nn.Sequential(nn.Linear(units, 4 * units), nn.ReLU(inplace=True), nn.Linear(4 * units, units))

    def forward(self, sequence: Tensor) -> Tensor:
        """(N, WINDOW - 1 + T, U) to the outputs of the last T steps (N, T, U)."""
        x = self.norm(sequence)
        query = self.query(x[:, WINDOW - 1 :]).unflatten(-1, (HEADS, -1))  # (N, T, heads, d)
        both = self.key_value(x).unfold(1, WINDOW, 1)  # (N, T, 2 U, WINDOW)
        key, value = both.unflatten(2, (2, HEADS, -1)).unbind(2)  # (N, T, heads, d, WINDOW)
        score = torch.einsum("nthd,nthdw->nthw", query, key) / math.sqrt(query.shape[-1])
        mixed = torch.einsum("nthw,nthdw->nthd", functional.softmax(score + self.age, dim=-1), value)
        y = sequence[:, WINDOW - 1 :] + self.out(mixed.flatten(2))
        result: Tensor = y + self.wide(self.norm_wide(y))
        return result


class Transformer(SequenceModel):
    """Two layers of causal attention. Its memory is the inputs of each layer at the last ``WINDOW`` steps.

    Before step 0, the memory is filled with a learned function of the first belief's mean.
    """

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        self.layers = nn.ModuleList(Attention(architecture.units) for _ in range(LAYERS))
        self.output = self.readout(architecture.units)
        self.initial = nn.Linear(self.features, LAYERS * architecture.units)

    def start(self, belief: Gaussian, particles: int, generator: torch.Generator) -> Recurrent:
        memory = self.initial(self.angles.features(belief.mean)).unflatten(-1, (LAYERS, 1, -1))
        return Recurrent(memory.expand(-1, -1, WINDOW, -1), belief.mean)

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Recurrent, StepTrace]:
        assert isinstance(belief, Recurrent)
        sequences, output = self.run(belief, evidence.observation)
        return self.read(belief, sequences[:, :, -WINDOW:], output[:, -1])

    def steps(
        self, belief: Belief, evidence: Evidence, generator: torch.Generator
    ) -> Iterator[tuple[Belief, StepTrace]]:
        """All steps at once: equal to single steps up to rounding."""
        assert isinstance(belief, Recurrent)
        sequences, output = self.run(belief, evidence.observation.squeeze(2).transpose(0, 1))
        for t, memory in enumerate(sequences.unfold(2, WINDOW, 1)[:, :, -len(evidence) :].unbind(2)):
            belief, trace = self.read(belief, memory.transpose(-1, -2), output[:, t])
            yield belief, trace

    def run(self, belief: Recurrent, x: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs (N, T, U) of T steps to each layer's inputs (N, L, WINDOW + T, U), and the outputs (N, T, U)."""
        sequences = []
        for layer, past in zip(self.layers, belief.hidden.unbind(1), strict=True):
            sequences.append(torch.cat([past, x], dim=1))
            x = layer(sequences[-1][:, 1:])
        return torch.stack(sequences, dim=1), x

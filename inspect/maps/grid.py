"""Measurement models over the cells of a grid of states: what cells and maps share is computed once, in buffers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from beliefscope.filters.models.networks import Residual
from beliefscope.filters.models.pf import MeasurementModel

CELLS_AT_ONCE = 2500
"""Cells that go through the networks in one go: a whole coarse map, and their activations stay in the caches. At least
the side of the largest grid."""

GRIDS_KEPT, CELLS_KEPT = 2, 20_000
"""Grids that are remembered, the newest of each size; and the cells that one may have at most."""


class Cells:
    """K measurement models on S x S states that differ in two components.

    Their first layer is linear, ``W s + b = (W_x dx) + (W_y dy + W s_0 + b)`` for the cell at offsets dx, dy from the
    state s_0 in the middle: S columns and S rows instead of S x S cells. The rest goes through the caches in chunks of
    rows, in place, in buffers that are made once: fresh memory costs as much as a layer. The state's part of the
    networks is kept once a grid is asked for again: the truth stands still, or the slice is held.
    """

    def __init__(self, models: Sequence[MeasurementModel], along: tuple[int, int], scale: Tensor) -> None:
        """along: components of the state to the right and upwards. scale: (n,) their standardised units, in SI."""
        self._models = models
        self._along = along
        self._scale = scale
        self._units = models[0].join_state.out_features
        self._buffers = torch.empty(2, CELLS_AT_ONCE, self._units)
        self._middles: dict[int, tuple[float, ...]] = {}  # by size, of the last grid
        self._parts: dict[int, Tensor] = {}  # (K, S^2, units) of those asked for again

    @torch.inference_mode()
    def log_likelihood(self, offsets: Tensor, state: Tensor, middle: tuple[float, ...], observation: Tensor) -> Tensor:
        """(K, S^2) row by row, not normalised.

        Args:
            offsets: (S,) SI, of cells from the middle, the same in both directions. state: (n,) the middle,
                standardised; ``middle`` is the same in SI, by which the grid is known again.
            observation: (K, units) what each model made of the observation.
        """
        size = len(offsets)
        known, part = self._remembered(size, middle)
        values = torch.empty(len(self._models), size * size)
        for k, (model, seen) in enumerate(zip(self._models, observation, strict=True)):
            columns, rows = self._first(model, offsets, state)
            *inner, last = model.head
            assert isinstance(last, nn.Linear)
            encoder, join, head = layers([*model.state_encoder][1:]), model.join_state.weight.T, layers(inner)
            for begin, end in chunks(size):
                x, y = self._buffers.narrow(1, 0, (end - begin) * size)
                here = slice(begin * size, end * size)
                if not known:
                    torch.add(columns, rows[begin:end, None], out=x.view(-1, size, self._units))
                    through(encoder, x, y)
                if part is None:
                    torch.addmm(seen, x, join, out=y)
                else:
                    if not known:
                        torch.mm(x, join, out=part[k, here])
                    torch.add(part[k, here], seen, out=y)
                through(head, y, x)
                torch.addmv(last.bias, y, last.weight[0], out=values[k, here])
        return values

    def _remembered(self, size: int, middle: tuple[float, ...]) -> tuple[bool, Tensor | None]:
        """Whether the grid's part is known, and where it is or belongs: nowhere before it is asked for again."""
        before = self._middles.pop(size, None)
        if size * size > CELLS_KEPT:
            return False, None
        self._middles[size] = middle
        if len(self._middles) > GRIDS_KEPT:
            oldest = next(iter(self._middles))
            self._middles.pop(oldest), self._parts.pop(oldest, None)
        if before != middle:
            self._parts.pop(size, None)
            return False, None
        known = size in self._parts
        if not known:
            self._parts[size] = torch.empty(len(self._models), size * size, self._units)
        return known, self._parts[size]

    def _first(self, model: MeasurementModel, offsets: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """(S, units) each: the first layer's summands by column and by row."""
        layer = model.state_encoder[0]
        assert isinstance(layer, nn.Linear)
        by_x, by_y = ((layer.weight / self._scale)[:, i] for i in self._along)
        return offsets[:, None] * by_x, offsets[:, None] * by_y + layer(state)


def chunks(size: int) -> Iterator[tuple[int, int]]:
    """First row and the row after the last of each chunk of a grid with ``size`` cells a side."""
    rows = max(1, CELLS_AT_ONCE // size)
    return ((row, min(row + rows, size)) for row in range(0, size, rows))


def layers(stack: Sequence[nn.Module]) -> list[tuple[Tensor, ...]]:
    """What ``through`` needs of each layer: of a ReLU nothing, of a residual one its weights and biases."""
    found: list[tuple[Tensor, ...]] = []
    for layer in stack:
        if isinstance(layer, Residual):
            found.append((layer.first.weight.T, layer.first.bias, layer.second.weight.T, layer.second.bias))
        else:
            assert isinstance(layer, nn.ReLU)
            found.append(())
    return found


def through(stack: list[tuple[Tensor, ...]], x: Tensor, y: Tensor) -> None:
    """Layers that keep the width, on x (cells, units) in place; y is room for as much."""
    for layer in stack:
        if layer:
            first, bias, second, second_bias = layer
            torch.addmm(bias, x, first, out=y).clamp_min_(0.0)
            x.add_(second_bias).addmm_(y, second)
        x.clamp_min_(0.0)


@contextmanager
def one_thread() -> Iterator[None]:
    """No threads inside of torch's operations: chunks are so small that threads mostly wait for one another."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)

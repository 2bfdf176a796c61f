"""Evaluation of measurement models over a grid of states, reusing values that cells and maps share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from beliefscope.filters.angles import Angles
from beliefscope.filters.models.networks import Residual
from beliefscope.filters.models.pf import MeasurementModel

CELLS_AT_ONCE = 2500
"""Cells per forward pass: a whole coarse map, whose activations fit into the CPU caches. Not below ``LARGEST``."""

CACHED_GRIDS, CACHED_CELLS = 2, 20_000
"""Number of cached grids, the latest of each size, and the maximum number of cells of a cached grid."""


class GridEvaluator:
    """Evaluates K measurement models on R x S states that differ in one or two components.

    The first layer is linear, ``W s + b = (W_x dx) + (W_y dy + W s_0 + b)`` for the cell at offsets dx, dy from the
    centre state s_0, so it is evaluated for S columns and S rows instead of S x S cells. The other layers run in
    place on chunks of rows that fit into the CPU caches, in preallocated buffers, because allocation costs as much as
    a layer. The state branch of the networks is cached when a grid is requested again, as for an object at rest or a
    fixed cross-section. Of an angle that wraps, the layer reads sine and cosine, which also add to its output.
    """

    def __init__(self, models: Sequence[MeasurementModel], scale: Tensor) -> None:
        """scale: (n,) standard deviations of the state components, SI."""
        self._models = models
        self._scale = scale
        self._units = models[0].join_state.out_features
        self._buffers = torch.empty(2, CELLS_AT_ONCE, self._units)
        self._grids: dict[int, tuple[float, ...]] = {}  # size -> centre and axes of the last grid
        self._parts: dict[int, Tensor] = {}  # size -> (K, S^2, units), state branch of repeated grids

    @torch.inference_mode()
    def log_likelihood(
        self, along: tuple[int, int], x: Tensor, y: Tensor, state: Tensor, key: tuple[float, ...], observation: Tensor
    ) -> Tensor:
        """(K, R S) log-likelihoods in row order, not normalised.

        Args:
            along: state components of the axes. x, y: (S,) and (R,) SI, offsets of columns and rows from the centre.
            state: (n,) centre, standardised.
            key: identifies centre and axes of the grid in the cache.
            observation: (K, units) observation features of each model.
        """
        size = len(x)
        cached, part = self._cached_part(size, len(y), key)
        values = torch.empty(len(self._models), size * len(y))
        for k, (model, features) in enumerate(zip(self._models, observation, strict=True)):
            columns, rows = self._first(model, along, x, y, state)
            *inner, last = model.head
            assert isinstance(last, nn.Linear)
            encoder, join, head = layers([*model.state_encoder][1:]), model.join_state.weight.T, layers(inner)
            for begin, end in chunks(size, len(y)):
                activation, scratch = self._buffers.narrow(1, 0, (end - begin) * size)
                rows_slice = slice(begin * size, end * size)
                if not cached:
                    torch.add(columns, rows[begin:end, None], out=activation.view(-1, size, self._units))
                    apply_layers(encoder, activation, scratch)
                if part is None:
                    torch.addmm(features, activation, join, out=scratch)
                else:
                    if not cached:
                        torch.mm(activation, join, out=part[k, rows_slice])
                    torch.add(part[k, rows_slice], features, out=scratch)
                apply_layers(head, scratch, activation)
                torch.addmv(last.bias, scratch, last.weight[0], out=values[k, rows_slice])
        return values

    def _cached_part(self, size: int, rows: int, key: tuple[float, ...]) -> tuple[bool, Tensor | None]:
        """Whether the grid's state branch is cached, and its cache entry; None until a grid is requested again."""
        before = self._grids.pop(size, None)
        if size * rows > CACHED_CELLS:
            return False, None
        self._grids[size] = key
        if len(self._grids) > CACHED_GRIDS:
            oldest = next(iter(self._grids))
            self._grids.pop(oldest), self._parts.pop(oldest, None)
        if before != key:
            self._parts.pop(size, None)
            return False, None
        cached = size in self._parts
        if not cached:
            self._parts[size] = torch.empty(len(self._models), size * rows, self._units)
        return cached, self._parts[size]

    def _first(
        self, model: MeasurementModel, along: tuple[int, int], x: Tensor, y: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        """(S, units) each: terms of the first layer by column and by row."""
        layer = model.state_encoder[0]
        assert isinstance(layer, nn.Linear)
        columns, rows = (
            self._term(model.angles, layer.weight, i, d, state) for i, d in zip(along, (x, y), strict=True)
        )
        return columns, rows + layer(model.angles.features(state))

    def _term(self, angles: Angles, weight: Tensor, i: int, offsets: Tensor, state: Tensor) -> Tensor:
        """(S, units): change of the first layer by offsets (S,) of component i. weight: (units, features)."""
        if i not in angles.indices:
            return offsets[:, None] * (weight[:, i] / self._scale[i])
        states = state.repeat(len(offsets), 1)
        states[:, i] += offsets / self._scale[i]
        return (angles.features(states) - angles.features(state)) @ weight.T


def chunks(columns: int, rows: int) -> Iterator[tuple[int, int]]:
    """First row and row after the last of each chunk of a grid."""
    step = max(1, CELLS_AT_ONCE // columns)
    return ((row, min(row + step, rows)) for row in range(0, rows, step))


def layers(stack: Sequence[nn.Module]) -> list[tuple[Tensor, ...]]:
    """Parameters of each layer for ``apply_layers``: empty for a ReLU, weights and biases for a residual layer."""
    parameters: list[tuple[Tensor, ...]] = []
    for layer in stack:
        if isinstance(layer, Residual):
            parameters.append((layer.first.weight.T, layer.first.bias, layer.second.weight.T, layer.second.bias))
        else:
            assert isinstance(layer, nn.ReLU)
            parameters.append(())
    return parameters


def apply_layers(stack: list[tuple[Tensor, ...]], x: Tensor, y: Tensor) -> None:
    """Apply layers of equal width to x (cells, units) in place; y is a buffer of the same shape."""
    for layer in stack:
        if layer:
            first, bias, second, second_bias = layer
            torch.addmm(bias, x, first, out=y).clamp_min_(0.0)
            x.add_(second_bias).addmm_(y, second)
        x.clamp_min_(0.0)

"""Building blocks of the networks: residual layers, encoders, and derivatives by the input."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Literal, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

Pooling = Literal["flatten", "spatial-softmax", "mean"]
Networks = Literal["default", "authors"]

CELLS_CHUNK = 1 << 14
"""Cells of feature maps convolved at once: enough to use all cores, few enough to stay in the CPU caches."""

IMAGES_CHUNK = 32
"""Least number of images encoded at once. Blocks of more than half as many have the same bits in any batch: products of
matrices with fewer than 16 rows sum in another order."""

ROW_CHUNK = 1024
"""Particles or map cells evaluated at once, so that their activations stay in the CPU caches."""


def in_chunks(function: Callable[[Tensor], Tensor], states: Tensor) -> Tensor:
    """``function`` of states (N, M, n), evaluated for a limited number of particles at once; result (N, M, ...)."""
    chunks = states.split(max(1, ROW_CHUNK // len(states)), dim=1)
    return function(states) if len(chunks) == 1 else torch.cat([function(chunk) for chunk in chunks], dim=1)


class Residual(nn.Module):
    """``relu(x + W2 relu(W1 x + b1) + b2)``, two layers of ``units``."""

    def __init__(self, units: int) -> None:
        super().__init__()
        self.first = nn.Linear(units, units)
        self.second = nn.Linear(units, units)

    def forward(self, x: Tensor) -> Tensor:
        y = self.second(functional.relu(self.first(x), inplace=True))
        return functional.relu(y.add_(x), inplace=True)

    def in_place(self, x: Tensor) -> Tensor:
        """The same without gradients, written over x."""
        y = linear(self.first, x).relu_()
        weight, bias = weight_and_bias(self.second)
        assert bias is not None
        torch.addmm(x, y, weight.t(), out=x)
        return x.add_(bias).relu_()

    def with_tangents(self, x: Tensor) -> Tensor:
        y = linear(self.second, relu_with_tangents(linear(self.first, x)))
        return relu_with_tangents(y + x)


def linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """The layer's output, without the cost of calling a module."""
    return functional.linear(x, *weight_and_bias(layer))


def weight_and_bias(layer: nn.Linear) -> tuple[Tensor, Tensor | None]:
    """The layer's parameters; as attributes, which modules search for, they cost a third of a small product."""
    weight, bias = layer._parameters["weight"], layer._parameters["bias"]
    assert weight is not None
    return weight, bias


def relu_with_tangents(x: Tensor) -> Tensor:
    """ReLU of x and, in the same linear piece, of x + dx: (n + 1, ..., d), x in the last row."""
    return x * x.detach()[-1].sign().relu_()


class Stack(nn.Sequential):
    """A sequence of Linear, ReLU and Residual layers, for inputs (..., d)."""

    def forward(self, x: Tensor) -> Tensor:
        shape = x.shape[:-1]
        rows = shape.numel()  # -1 would be ambiguous for vectors without entries, such as no controls
        if not torch.is_grad_enabled():
            x = self._without_gradients(x.reshape(rows, x.shape[-1]))
            return x.view(*shape, x.shape[-1])
        for layer in self:
            if not isinstance(layer, nn.ReLU):
                # With more axes, a layer's output is a view: operations in place on it would copy its gradient.
                x = x.reshape(rows, x.shape[-1])
            x = layer(x)
        return x.view(*shape, x.shape[-1])

    def _without_gradients(self, x: Tensor) -> Tensor:
        """Rows (B, d) in few buffers, which stay in the CPU caches, and without the cost of calling modules.

        Their hooks are therefore called with gradients enabled only.
        """
        return self._through(x, Tensor.relu_, Residual.in_place)

    def with_tangents(self, x: Tensor) -> Tensor:
        """``x + dx_i`` and, in the last row, x to ``f(x) + f'(x) dx_i`` and f(x): (n + 1, ..., d).

        All rows pass through the linear piece of the network that contains x, so dx need not be small.
        """
        return self._through(x, relu_with_tangents, Residual.with_tangents)

    def _through(
        self, x: Tensor, relu: Callable[[Tensor], Tensor], residual: Callable[[Residual, Tensor], Tensor]
    ) -> Tensor:
        """The layers with other functions for ReLU and residual layers, which are not called as modules."""
        for layer in self:
            if isinstance(layer, nn.ReLU):
                x = relu(x)
            elif isinstance(layer, nn.Linear):
                x = linear(layer, x)
            else:
                assert isinstance(layer, Residual)
                x = residual(layer, x)
        return x


class NoInputs(nn.Linear):
    """A linear layer of a vector without entries, such as no controls: its bias, initially 0."""

    def reset_parameters(self) -> None:
        """As ``nn.Linear``, with the same random draws, but without its warning that there are no weights."""
        nn.init.uniform_(self.bias, 0.0, 0.0)


def vector_stack(inputs: int, units: int) -> Stack:
    """Three layers from ``inputs`` to ``units``."""
    first = nn.Linear(inputs, units) if inputs else NoInputs(0, units)
    return Stack(first, nn.ReLU(inplace=True), Residual(units))


class VectorEncoder(nn.Module):
    """A vector (..., d) to the joined features (..., groups x units) of one encoder for each group of its entries."""

    def __init__(self, groups: Sequence[Sequence[int]], units: int) -> None:
        super().__init__()
        self.groups = [list(group) for group in groups]
        self.by_group = nn.ModuleList(vector_stack(len(group), units) for group in groups)

    def forward(self, x: Tensor) -> Tensor:
        parts = zip(self.by_group, self.groups, strict=True)
        return torch.cat([encoder(x[..., group]) for encoder, group in parts], dim=-1)


class ResidualConvolution(nn.Module):
    """Residual block of two 3x3 convolutions."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        y = self.second(functional.relu(self.first(x), inplace=True))
        return functional.relu(y.add_(x), inplace=True)


class ChannelsFirst(nn.Module):
    """Images (B, C, H, W) in the order of their axes in memory, which pooling reads."""

    def forward(self, x: Tensor) -> Tensor:
        return x.contiguous()


class SpatialSoftmax(nn.Module):
    """Channels (B, C, H, W) to the mean x and y (B, 2 C) of each channel's softmax, from -1 to 1.

    Levine et al., "End-to-End Training of Deep Visuomotor Policies", 2016.
    """

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        share = torch.softmax(x.flatten(2), dim=-1).unflatten(-1, (height, width))
        along_x = torch.linspace(-1.0, 1.0, width, dtype=x.dtype, device=x.device)
        along_y = torch.linspace(-1.0, 1.0, height, dtype=x.dtype, device=x.device)
        return torch.cat([share.sum(-2) @ along_x, share.sum(-1) @ along_y], dim=-1)


class FeatureTable(Protocol):
    """Features of images: a tensor, or one that is computed on demand."""

    def __getitem__(self, indices: Tensor, /) -> Tensor: ...


class ImageEncoder(nn.Module):
    """Images (B, H, W), standardised, to features (B, units).

    Pooling reduces the convolutions' 8 channels: ``flatten`` keeps every cell, ``spatial-softmax`` the position of each
    channel's activation, ``mean`` its average. A first layer of stride 2 needs a quarter of the operations of full
    resolution.

    Attributes:
        chunk: largest number of images to encode at once.
        table: cached features (images, units) by image index; only while the encoder is frozen during training.
        images: image indices (...) to images (..., H, W), standardised; only while the encoder is trained on indices.
    """

    table: FeatureTable | None = None
    images: Callable[[Tensor], Tensor] | None = None

    def __init__(
        self,
        shape: tuple[int, int],
        units: int,
        stride: int = 2,
        pooling: Pooling = "flatten",
        networks: Networks = "default",
    ) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            nn.Conv2d(1, 32, 5, stride=stride, padding=2),
            nn.ReLU(inplace=True),
            ResidualConvolution(32),
            nn.Conv2d(32, 16, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(16, 8, 3, padding=1),
            ChannelsFirst(),
            nn.Identity() if networks == "authors" else nn.ReLU(inplace=True),
        )
        # With channels last, convolutions on a CPU take two thirds of the time.
        self.convolutions.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        keep_freed_memory()
        cells = -(-shape[0] // stride) * -(-shape[1] // stride)
        self.chunk = max(IMAGES_CHUNK, CELLS_CHUNK // cells)
        size, self.pooling = {
            "flatten": (8 * cells, nn.Flatten()),
            "spatial-softmax": (16, SpatialSoftmax()),
            "mean": (8, nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten())),
        }[pooling]
        self.output = Stack(nn.Linear(size, units), nn.ReLU(inplace=True), Residual(units))

    def forward(self, images: Tensor) -> Tensor:
        features: Tensor = self.output(self.pooling(self.convolutions(images.unsqueeze(1))))
        return features


def keep_freed_memory() -> None:
    """Lets the C library reuse the memory of feature maps instead of returning it to the system after every layer.

    The next layer would have its pages mapped again, which takes a fifth to a third of an encoder's time. glibc returns
    blocks above a threshold and raises it to the size of any block that is freed, at most 32 MiB; this one is not used.
    """
    torch.empty(31 << 20, dtype=torch.uint8)


class Encoders(nn.Module):
    """One encoder per modality, with joined features: observations (T, N, ...) to (T, N, ``size``).

    groups: modality -> groups of its vector's entries, each with an encoder of its own; other vectors have one encoder.
    """

    def __init__(
        self,
        shapes: Mapping[str, tuple[int, ...]],
        units: int,
        image_stride: int,
        pooling: Pooling = "flatten",
        networks: Networks = "default",
        groups: Mapping[str, Sequence[Sequence[int]]] = MappingProxyType({}),
    ) -> None:
        super().__init__()
        self.by_modality = nn.ModuleDict()
        self.size = 0
        for modality, shape in shapes.items():
            if len(shape) == 2:
                size = (shape[0], shape[1])
                self.by_modality[modality] = ImageEncoder(size, units, image_stride, pooling, networks)
            elif modality in groups:
                self.by_modality[modality] = VectorEncoder(groups[modality], units)
            else:
                self.by_modality[modality] = vector_stack(shape[0], units)
            self.size += units * len(groups.get(modality, [shape]))

    def forward(self, observations: Mapping[str, Tensor]) -> Tensor:
        features = []
        for modality, encoder in self.by_modality.items():
            observed = observations[modality]
            if isinstance(encoder, ImageEncoder) and encoder.images is not None:
                observed = encoder.images(observed)
            if isinstance(encoder, ImageEncoder) and observed.dtype == torch.int64:
                assert encoder.table is not None
                features.append(encoder.table[observed])
            elif isinstance(encoder, ImageEncoder):
                images = observed.flatten(0, 1)
                blocks = images.tensor_split(max(1, -(-len(images) // encoder.chunk)))  # of almost equal size
                features.append(torch.cat([encoder(block) for block in blocks]).unflatten(0, observed.shape[:2]))
            else:
                features.append(encoder(observed))
        return torch.cat(features, dim=-1)


def reset_weights(module: nn.Module) -> None:
    """Initialises a module's weights from torch's global generator."""
    reset = getattr(module, "reset_parameters", None)
    if callable(reset):
        reset()
    else:
        for child in module.children():
            reset_weights(child)

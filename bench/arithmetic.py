"""Operations of a function, the rate of this machine, and the floor: the time of the operations at that rate."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from beliefscope.filters.models.networks import CELLS_CHUNK, ROW_CHUNK

UNITS, CHANNELS, IMAGE = 64, 32, 32


@dataclass(frozen=True)
class Flops:
    """Floating-point operations, two for each product. products: of matrices; convolutions: of the image encoders."""

    products: int
    convolutions: int

    @property
    def total(self) -> int:
        return self.products + self.convolutions


@dataclass(frozen=True)
class Rate:
    """Operations a CPU-second of matrix products and of convolutions, with the networks' largest shapes."""

    products: float
    convolutions: float

    def seconds(self, flops: Flops) -> float:
        return flops.products / self.products + flops.convolutions / self.convolutions


def count(function: Callable[[], object]) -> Flops:
    with FlopCounterMode(display=False) as counter:
        function()
    counts = counter.get_flop_counts()["Global"]
    convolutions = sum(value for operator, value in counts.items() if "convolution" in str(operator))
    return Flops(sum(counts.values()) - convolutions, convolutions)


def cpu_seconds(function: Callable[[], object]) -> float:
    began = time.process_time()
    function()
    return time.process_time() - began


@torch.no_grad()
def measure_rate() -> Rate:
    """The rates now: a layer of ROW_CHUNK x 64 x 64, and a 3 x 3 convolution of 32 channels over CELLS_CHUNK cells."""
    linear, rows = nn.Linear(UNITS, UNITS, bias=False), torch.randn(ROW_CHUNK, UNITS)
    convolution = nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    maps = torch.randn(CELLS_CHUNK // IMAGE**2, CHANNELS, IMAGE, IMAGE).contiguous(memory_format=torch.channels_last)
    return Rate(_rate(lambda: linear(rows), 300), _rate(lambda: convolution(maps), 3))


def _rate(function: Callable[[], Tensor], calls: int) -> float:
    function()

    def repeat() -> None:
        for _ in range(calls):
            function()

    return calls * count(function).total / min(cpu_seconds(repeat) for _ in range(3))


def spread(values: list[float], digits: int = 1) -> str:
    """``median [least, greatest]``."""
    return f"{median(values):.{digits}f} [{min(values):.{digits}f}, {max(values):.{digits}f}]"

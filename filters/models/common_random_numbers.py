"""Where a filter's random numbers come from; the first axis of what is drawn is the batch of N trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


class Common(torch.Generator):
    """A generator that gives all trajectories of a batch the same numbers: those of a batch of one.

    With common random numbers, runs that differ only in their evidence differ only because of it.
    """


def normal(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Standard normal numbers of this shape, on the generator's device."""
    return _drawn(torch.randn, shape, generator)


def uniform(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Numbers from [0, 1) of this shape, on the generator's device."""
    return _drawn(torch.rand, shape, generator)


def _drawn(draw: Callable[..., Tensor], shape: Sequence[int], generator: torch.Generator) -> Tensor:
    if isinstance(generator, Common):
        return draw((1, *shape[1:]), generator=generator, device=generator.device).expand(*shape)
    return draw(tuple(shape), generator=generator, device=generator.device)

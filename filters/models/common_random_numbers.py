"""Random numbers of a filter; their first axis is the batch of N trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


class Common(torch.Generator):
    """A generator that gives all trajectories of a batch the same numbers, those of a batch of one.

    With common random numbers, differences between runs are due to their evidence only.
    """


def normal(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Standard normal numbers of this shape, on the generator's device."""
    return _sample(torch.randn, shape, generator)


def uniform(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Numbers from [0, 1) of this shape, on the generator's device."""
    return _sample(torch.rand, shape, generator)


def _sample(function: Callable[..., Tensor], shape: Sequence[int], generator: torch.Generator) -> Tensor:
    if isinstance(generator, Common):
        return function((1, *shape[1:]), generator=generator, device=generator.device).expand(*shape)
    return function(tuple(shape), generator=generator, device=generator.device)

"""Angles that wrap around: components of a state whose values are equal modulo a turn (``Component.wraps``)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task, display_name

TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Angles:
    """The wrapping angles of states (..., n). They are in rad where other components are standardised.

    Networks read an angle's sine and cosine, so that they are continuous, and an angle that a network reports is that
    of two numbers. Differences are taken modulo a turn by moving one of the states near the other.

    Attributes:
        indices: of the angles in the state. Without any, all functions return their argument.
    """

    indices: tuple[int, ...] = ()

    @classmethod
    def from_task(cls, task: Task) -> Angles:
        """Those of a task's state."""
        return cls(tuple(i for i, component in enumerate(task.components) if component.wraps))

    def features(self, states: Tensor) -> Tensor:
        """States (..., n) to (..., n + angles): the sine in place of each angle, the cosines at the end."""
        if not self.indices:
            return states
        index = self._index(states)
        angles = states[..., index]
        return torch.cat([states.index_copy(-1, index, angles.sin()), angles.cos()], dim=-1)

    def features_with_tangents(self, x: Tensor) -> Tensor:
        """As ``features`` for ``x + dx_i`` and, in the last row, x: derivatives, as in ``Stack.with_tangents``."""
        if not self.indices:
            return x
        index = self._index(x)
        angles = x[..., index]
        last = angles[-1]
        sine, cosine, change = last.sin(), last.cos(), angles - last
        return torch.cat([x.index_copy(-1, index, sine + cosine * change), cosine - sine * change], dim=-1)

    def states(self, features: Tensor) -> Tensor:
        """Inverse of ``features``, for sines and cosines of any common length: (..., n + angles) to (..., n)."""
        if not self.indices:
            return features
        n = features.shape[-1] - len(self.indices)
        states, index = features[..., :n], self._index(features)
        return states.index_copy(-1, index, torch.atan2(states[..., index], features[..., n:]))

    def near(self, states: Tensor, reference: Tensor) -> Tensor:
        """States (..., n) whose angles are at most half a turn from those of a reference that broadcasts to them."""
        if not self.indices:
            return states
        index = self._index(states)
        states = states.expand(torch.broadcast_shapes(states.shape, reference.shape))
        turns = torch.round((states[..., index] - reference[..., index]) / TURN)
        return states.index_add(-1, index, turns, alpha=-TURN)

    def wrapped(self, states: Tensor) -> Tensor:
        """States (..., n) with angles from -pi to pi."""
        return self.near(states, torch.zeros_like(states)) if self.indices else states

    def difference(self, states: Tensor, reference: Tensor) -> Tensor:
        """``states - reference`` with angles from -pi to pi."""
        return self.wrapped(states - reference)

    def centred(self, states: Tensor, log_weights: Tensor) -> Tensor:
        """Particles (..., M, n) near their mean direction, so that their mean and covariance are those of the angles.

        log_weights: (..., M), normalised. The mean direction is that of the sums of sines and of cosines.
        """
        if not self.indices:
            return states
        weights = log_weights.exp().unsqueeze(-2)
        direction = torch.atan2(weights @ states.sin(), weights @ states.cos())
        return self.near(states, direction)

    def _index(self, states: Tensor) -> Tensor:
        return torch.tensor(self.indices, device=states.device)


NO_ANGLES = Angles()
"""Of a state without wrapping angles."""


def jumping_angles(episodes: Sequence[Episode]) -> dict[str, int]:
    """Angles that jump by more than half a turn although their component does not wrap -> number of episodes."""
    numbers = {}
    for i, component in enumerate(episodes[0].task.components if episodes else ()):
        if component.unit == "rad" and not (component.rotation or component.wraps):
            numbers[component.name] = sum((np.abs(np.diff(e.states[:, i])) > np.pi).any() for e in episodes)
    return {name: int(number) for name, number in numbers.items() if number}


def wrapping_warning(episodes: Sequence[Episode]) -> str | None:
    """One line about ``jumping_angles`` of the training episodes."""
    training = [episode for episode in episodes if episode.split == "train"]
    jumps = jumping_angles(training)
    if not jumps:
        return None
    episodes_text = f"of {len(training)} training episodes"
    lines = [f"{display_name(name)} wraps around in {number} {episodes_text}" for name, number in jumps.items()]
    return (
        f"{'; '.join(lines)}. The filter learns a number that jumps, so that its errors will be large: declare the "
        "component with wraps=True (docs/data.md)"
    )

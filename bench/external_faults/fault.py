"""What the tasks share: the description of a fault, angles, a delay, episodes with a masked sensor, and weights."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from safetensors.torch import load_file
from torch import Tensor

import beliefscope as bs

Values = np.ndarray


class Fault(NamedTuple):
    """A planted fault.

    Attributes:
        where: ``data`` or ``filter``.
        description: with its magnitude.
        accepted: regular expression of the causes that are a correct diagnosis; chosen before the first one.
        source: public report of the mistake, ``owner/repository#number``; empty for a fault without one.
    """

    where: str
    description: str
    accepted: str
    source: str = ""


def wrap(angle: Values) -> Values:
    """Angles in [-pi, pi), rad."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def hold(values: Values, present: Values) -> Values:
    """Readings (T, C) that keep their last value at the steps without a new one; present: (T,) boolean."""
    held, last = np.zeros_like(values), values[0]
    for t in range(len(values)):
        last = values[t] if present[t] else last
        held[t] = last
    return held


def masked_episode(
    task: bs.Task, states: Values, controls: Values, readings: dict[str, Values], seen: Values, seed: int
) -> bs.Episode:
    """An episode whose masked sensor, the only one of the task, has new readings at some steps; seen: (T,) boolean."""
    ((key, covariate),) = task.masks.items()
    readings = {**readings, key: hold(readings[key], seen)}
    covariates = {covariate: seen.astype(np.float32)}
    return bs.Episode(
        task, states, controls=controls, observations=readings, covariates=covariates, seed=seed, split="test"
    )


def delay(values: Values, steps: int) -> Values:
    """Readings (T, C) that arrive ``steps`` later; the first one fills the start."""
    return np.concatenate([np.repeat(values[:1], steps, 0), values[:-steps]])


def stored(path: Path) -> dict[str, Tensor]:
    """Trained weights in 32 bits; some are stored in 16 bits."""
    return {key: value.float() for key, value in load_file(path).items()}

"""The warning of angles that wrap around in training data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.training.angles import wrapping_warning

TASK = Task("robot", (Component("x", "m"), Component("yaw", "rad")), {"gps": (1,)}, {"gps": ("gps",)}, 0, 0.1)


def robot(yaw: np.ndarray, split: str = "train") -> Episode:
    states = np.stack([5.0 * np.cos(yaw), yaw], axis=1)
    return Episode(TASK, states, observations={"gps": states[:, :1]}, split=split)


def test_angles_that_wrap_around_are_named() -> None:
    turning = np.linspace(2.0, 5.0, 50)
    wrapped = robot((turning + np.pi) % (2.0 * np.pi) - np.pi)
    message = wrapping_warning([robot(turning), wrapped, wrapped])
    assert message is not None
    assert message.startswith("yaw wraps around in 2 of 3 training episodes. Built-in filters treat angles as numbers")
    assert wrapping_warning([robot(turning)]) is None
    assert wrapping_warning([replace(wrapped, split="test")]) is None
    assert wrapping_warning([]) is None

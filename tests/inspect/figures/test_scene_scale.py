"""Sizes in the 3D scene of tasks whose map is small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.figures.scene_belief import DrawnBelief
from beliefscope.inspect.figures.scene_shapes import grid
from beliefscope.inspect.trace import Trace, trace

TASK = Task("peg", (Component("x", "m"), Component("y", "m")), {"wrench": (2,)}, {"touch": ("wrench",)}, 0, 0.1)


def run(half_width: float) -> Trace:
    task = replace(TASK, map_half_width=half_width)
    still = Adapter(lambda observations, controls: np.zeros((30, 2)), batched=False, initial_std=(1.0, 1.0))
    episode = Episode(task, np.zeros((30, 2)), observations={"wrench": np.zeros((30, 2))})
    return trace(as_external(still, "still", task), episode)


@pytest.mark.parametrize("half_width", [0.01, 0.05])
def test_poles_and_grid_are_as_small_as_the_map(half_width: float) -> None:
    small, full = run(half_width), run(0.135)
    ratio = DrawnBelief(small.task, small).pole_height(0) / DrawnBelief(full.task, full).pole_height(0)
    assert ratio == pytest.approx(half_width / 0.1)
    assert np.ptp(grid(small.task, small).lines[..., 0]) < 4 * half_width


def test_scenes_of_full_size_are_not_scaled() -> None:
    full = run(0.135)
    assert DrawnBelief(full.task, full).scale == 1.0


def test_scenes_of_long_paths_have_a_coarse_grid_and_high_poles() -> None:
    still = run(20.0)
    states = np.linspace([0.0, 0.0], [1000.0, 300.0], 30, dtype=np.float32)
    path = replace(still, episode=replace(still.episode, states=states), estimate_mean=states)
    small, large = DrawnBelief(still.task, still), DrawnBelief(path.task, path)
    assert len(grid(path.task, path).lines) < 32
    assert large.pole_height(0) == pytest.approx(500.0 * small.pole_height(0))
    eye, target = large.viewpoints(None)["above"]
    assert np.linalg.norm(eye - target) > 1000.0

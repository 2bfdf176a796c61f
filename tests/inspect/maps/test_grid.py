"""The grid's values equal those of the measurement models, called for every cell."""

from __future__ import annotations

import pytest
import torch

from beliefscope.datasets.task import Component, Task
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.inspect.maps.grid import GridEvaluator

COMPONENTS = (Component("x", "m"), Component("heading", "rad", wraps=True), Component("y", "m"))
ROBOT = Task("robot", COMPONENTS, {"gps": (2,), "compass": (2,)}, {"gps": ("gps",), "compass": ("compass",)}, 2, 0.1)


@pytest.mark.parametrize("along", [(0, 2), (0, 1), (1, 2)])
def test_grid_equals_the_models_also_along_an_angle_that_wraps(along: tuple[int, int]) -> None:
    filter_ = build(architecture(ROBOT, "crossmodal-pf"))
    assert isinstance(filter_, MixtureParticleFilter)
    scale, centre = torch.tensor([0.5, 1.0, 2.0]), torch.tensor([0.3, 3.0, -0.2])
    x, y = torch.linspace(-4.0, 4.0, 9), torch.linspace(-3.0, 3.0, 7)
    observation = torch.randn(2, filter_.architecture.units, generator=torch.Generator().manual_seed(0))
    cells = centre.repeat(7, 9, 1)
    cells[..., along[0]] += x / scale[along[0]]
    cells[..., along[1]] += (y / scale[along[1]])[:, None]
    models = [filter_.measurement_model(name) for name in filter_.names]
    with torch.no_grad():
        expected = torch.stack(
            [m.log_likelihood(o, m.state_part(cells)).flatten() for m, o in zip(models, observation, strict=True)]
        )
    evaluator = GridEvaluator(models, scale)
    for _ in range(3):  # the last time from the cache
        values = evaluator.log_likelihood(along, x, y, centre, (1.0, *along), observation)
        torch.testing.assert_close(values, expected, atol=1e-5, rtol=1e-5)

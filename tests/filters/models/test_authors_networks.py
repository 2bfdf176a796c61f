"""The published networks: numbers of parameters and operations, shapes, and a working filter."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.batch import Batch
from beliefscope.filters.catalog import NETWORKS, architecture, build
from beliefscope.filters.filter import vector_groups
from beliefscope.filters.rollout import first_belief, rollout

PUBLISHED = {
    "crossmodal-pf": {
        "dynamics": 50_887,
        "measurement_models": 646_362,
        "weight_model": 612_634,
    },
    "feature-pf": {"dynamics": 50_887, "measurement_models": 616_921},
    "crossmodal-ekf": {
        "dynamics": 50_887,
        "virtual_sensors": 733_044,
        "weight_model": 596_254,
    },
    "feature-ekf": {"dynamics": 50_887, "virtual_sensors": 666_406},
}
"""Parameters of the door filters of github.com/brentyi/multimodalfilter, commit 210b0e2, ``crossmodal/door_models``.

The dynamics count once (its Kalman filters have a copy each) and with 3 values of process noise (its Kalman filters
store a 3 x 3 matrix). ``python bench/filters.py --reference DIR`` counts them again."""


def sizes(filter_: nn.Module) -> dict[str, int]:
    counts = {name: sum(p.numel() for p in child.parameters()) for name, child in filter_.named_children()}
    return {name: count for name, count in counts.items() if count}


@pytest.mark.parametrize("name", PUBLISHED)
def test_parameters_equal_the_published_ones(name: str) -> None:
    assert sizes(build(architecture("door", name, "authors"))) == PUBLISHED[name]


def test_position_and_sensors_have_their_own_encoders() -> None:
    assert vector_groups(find_task("door"), "haptics") == [[0, 1, 2], [3, 4, 5, 6, 7, 8, 9]]
    model = build(architecture("door", "crossmodal-pf", "authors")).get_submodule("measurement_models.haptics")
    encoder = model.get_submodule("encoders.by_modality.haptics")
    x = torch.randn(5, 10, requires_grad=True)
    encoder(x)[:, :64].sum().backward()
    assert x.grad is not None
    assert x.grad[:, :3].abs().sum() > 0
    assert x.grad[:, 3:].abs().sum() == 0


@pytest.mark.parametrize("task", ["door", "push"])
@pytest.mark.parametrize(
    ("name", "trained"),
    [
        ("crossmodal-ekf", {"virtual_sensors", "weight_model", "dynamics"}),
        ("crossmodal-ukf", {"virtual_sensors", "weight_model", "dynamics"}),
        ("unimodal-pf", {"measurement_models", "dynamics"}),
        ("lstm", {"encoders", "layers"}),
    ],
)
def test_filters_run_and_train(task: str, name: str, trained: set[str]) -> None:
    filter_ = build(architecture(task, name, "authors"))
    shape, n = (3, 2), filter_.n
    images = torch.randint(256, (*shape, 32, 32), dtype=torch.uint8)
    batch = Batch(
        {"image": images, "haptics": torch.randn(*shape, 10)},
        torch.randn(*shape, 7),
        torch.randn(*shape, n),
        torch.zeros(shape, dtype=torch.bool),
        torch.randn(2, n),
    )
    start = first_belief(filter_, batch)
    mean = rollout(filter_, filter_.encode(batch), start, torch.Generator().manual_seed(0), 8).estimate.mean
    assert mean.shape == (*shape, n)
    mean.square().sum().backward()
    assert trained <= {
        key.split(".")[0] for key, p in filter_.named_parameters() if p.grad is not None and p.grad.any()
    }


def test_operations_of_the_image_encoder() -> None:
    """Two operations for each product: five convolutions over 32 x 32 cells and three fully connected layers."""
    encoder = build(architecture("door", "image-pf", "authors")).get_submodule(
        "measurement_models.image.encoders.by_modality.image"
    )
    with FlopCounterMode(display=False) as counter:
        encoder(torch.randn(1, 32, 32))
    weights = 25 * 32 + 2 * 9 * 32 * 32 + 9 * 32 * 16 + 9 * 16 * 8
    assert counter.get_total_flops() == 2 * (32 * 32 * weights + 8 * 32 * 32 * 64 + 2 * 64 * 64)


def test_unknown_networks_are_rejected() -> None:
    with pytest.raises(BadInput, match="'paper' does not exist"):
        architecture("door", "crossmodal-pf", "paper")
    assert architecture("door", "lstm") == architecture("door", "lstm", next(iter(NETWORKS)))

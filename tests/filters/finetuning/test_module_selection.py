"""Module names, patterns and presets: selected and frozen parameters, and errors."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.catalog import architecture, build, filters_of
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.module_selection import (
    digest,
    freeze,
    module_change,
    module_tree,
    named_tensors,
    presets,
    select_parameters,
)

pytestmark = pytest.mark.slow


def door(name: str = "crossmodal-ekf") -> Filter:
    return build(architecture("door", name))


class ExternalModule(nn.Module):
    """An external network with running statistics, dropout and a shared layer."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Linear(4, 4), nn.BatchNorm1d(4), nn.Dropout(0.5))
        self.plain = nn.BatchNorm1d(4, affine=False)
        self.head = nn.Linear(4, 4)
        self.again = self.head
        self.scale = nn.Parameter(torch.ones(1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.again(self.head(self.plain(self.body(x)))) * self.scale


@pytest.mark.first(5)
@pytest.mark.parametrize("name", filters_of(find_task("door")))
def test_module_tree_contains_every_parameter_once(name: str) -> None:
    filter_ = door(name)
    nodes = {node.name: node for node in module_tree(filter_)}
    total = sum(p.numel() for p in filter_.parameters())
    assert nodes[""].parameters == total
    top = [node for node in nodes.values() if node.depth == 1]
    assert sum(node.parameters for node in top) == total
    assert nodes[""].buffers == sum(b.numel() for b in filter_.buffers()) == nodes["statistics"].buffers
    assert set(dict(filter_.named_modules())) <= set(nodes)
    available = presets(filter_)
    assert len(list(select_parameters(filter_, ["all"]))) == len(list(filter_.parameters()))
    assert ("weights-only" in available) == name.startswith(("crossmodal", "information"))
    assert all(set(select_parameters(filter_, [preset])) for preset in available)


def test_presets_select_their_modules() -> None:
    filter_ = door()

    def heads(preset: str, depth: int = 2) -> set[str]:
        return {".".join(name.split(".")[:depth]) for name in select_parameters(filter_, [preset])}

    assert heads("haptics-only") == {"virtual_sensors.haptics"}
    assert heads("image-only") == {"virtual_sensors.image"}
    assert heads("weights-only", 1) == {"weight_model"}
    assert not [name for name in select_parameters(filter_, ["weights-only"]) if ".image" in name]
    assert heads("noise-only", 1) == {"dynamics", "virtual_sensors"}
    assert all("log_noise" in name for name in select_parameters(filter_, ["noise-only"]))
    assert heads("dynamics-only", 1) == {"dynamics"}
    assert not set(select_parameters(filter_, ["haptics-only"])) & set(select_parameters(filter_, ["weights-only"]))


def test_patterns_match_at_any_depth_and_freeze_takes_precedence() -> None:
    filter_ = door()
    every = set(select_parameters(filter_))
    image = set(select_parameters(filter_, ["virtual_sensors.image.*"]))
    assert (
        image
        == set(select_parameters(filter_, ["virtual_sensors.image"]))
        == {n for n in every if "sensors.image." in n}
    )
    assert set(select_parameters(filter_, freeze=["virtual_sensors.image"])) == every - image
    assert set(select_parameters(filter_, ["weight_model.trunk.0.bias"])) == {"weight_model.trunk.0.bias"}
    both = select_parameters(filter_, ["haptics-only", "weights-only"], ["*.log_noise"])
    assert set(both) == {
        n
        for n in [*select_parameters(filter_, ["haptics-only"]), *select_parameters(filter_, ["weights-only"])]
        if "log_noise" not in n
    }
    states = {node.name: node.state for node in module_tree(filter_, both)}
    assert states["weight_model.trunk"] == states["virtual_sensors.haptics.trunk"] == "trained"
    assert states["virtual_sensors"] == states[""] == states["virtual_sensors.haptics"] == "partly trained"
    assert states["dynamics"] == states["virtual_sensors.image"] == "frozen"
    assert states["statistics"] == "-"


def test_patterns_without_match_are_rejected_with_suggestions() -> None:
    filter_ = door()
    with pytest.raises(
        BadInput, match=r"'weigth_model' matches no module.*Did you mean weight_model.*Available: .*all;"
    ):
        select_parameters(filter_, freeze=["weigth_model"])
    with pytest.raises(BadInput, match=r"'touch-only' matches no module .*haptics-only"):
        select_parameters(filter_, ["touch-only"])
    with pytest.raises(BadInput, match=r"--train dynamics-only --freeze dynamics leaves nothing to train"):
        select_parameters(filter_, ["dynamics-only"], ["dynamics"])


def test_frozen_parameters_and_buffers_do_not_change() -> None:
    torch.manual_seed(0)
    module = ExternalModule()
    for train, expected in (
        (["head"], {"head.weight", "head.bias", "again.weight", "again.bias"}),
        (["body.0"], {"body.0.weight", "body.0.bias"}),
        (["body.1.weight"], {"body.1.weight", "body.1.running_mean", "body.1.running_var"}),
    ):
        copied = copy.deepcopy(module)
        trained = select_parameters(copied, train)
        frozen = freeze(copied, trained)
        before = {name: tensor.clone() for name, tensor in named_tensors(copied).items()}
        before_digest = digest(copied, frozen)
        optimiser = torch.optim.SGD(trained.values(), lr=0.1)
        copied(3.0 + torch.randn(8, 4)).square().sum().backward()
        optimiser.step()
        changed = {name for name, tensor in named_tensors(copied).items() if not torch.equal(tensor, before[name])}
        assert changed - {"body.1.num_batches_tracked"} == expected, train
        assert digest(copied, frozen) == before_digest
        assert not changed & set(frozen)
    # A tensor with two names can be frozen by either.
    assert set(select_parameters(module, freeze=["again"])) == {
        "body.0.weight",
        "body.0.bias",
        "body.1.weight",
        "body.1.bias",
    } | {"scale"}
    assert presets(module) == {"all": ("*",)}
    assert next(node for node in module_tree(module)).description.startswith("An external network")


def test_digest_depends_on_every_bit() -> None:
    module = ExternalModule()
    names = list(named_tensors(module))
    before = digest(module, names)
    assert digest(module, reversed(names)) == before
    with torch.no_grad():
        weight = module.head.weight
        weight[0, 0] = torch.nextafter(weight[0, 0], torch.tensor(9.0))
    assert digest(module, names) != before
    assert digest(module, [name for name in names if not name.startswith(("head", "again"))]) != before


def test_module_change_combines_parameters() -> None:
    changes = {"a.x": [3.0, 1.0, 3.0], "a.y": [4.0, 0.0, 4.0], "b": [1.0, 2.0, 4.0]}
    assert module_change("a", changes) == {"gradient": 5.0, "change": 0.2}
    assert module_change("b", changes) == {"gradient": 1.0, "change": 0.5}
    assert module_change("ab", changes) == {"gradient": 0.0, "change": 0.0}

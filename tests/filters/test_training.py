"""Training in miniature: every stage runs, the same seed gives the same weights, and only what should train does."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import FILTERS, architecture, build
from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint, shipped
from beliefscope.filters.train import PLANS, train
from beliefscope.filters.trainer import Trainer

SMOKE = PLANS["smoke"]


def episodes(count: int = 10) -> list:
    with open_dataset(sample_path("door")) as dataset:
        return [dataset[i] for i in range(count)]


@pytest.mark.parametrize("name", FILTERS)
def test_same_seed_same_checkpoint(name: str, tmp_path: Path) -> None:
    some = episodes(8)  # all of split train: nothing to measure on
    hashes = []
    for number in range(2):
        trained = train(architecture("door", name), some, data_hash="-", plan=SMOKE, seed=5)
        hashes.append(save_checkpoint(trained.filter, name, {}, tmp_path / f"{number}.safetensors"))
        assert all(torch.isfinite(p).all() for p in trained.filter.parameters())
    assert hashes[0] == hashes[1]
    other = train(architecture("door", name), some, data_hash="-", plan=SMOKE, seed=6)
    assert save_checkpoint(other.filter, name, {}, tmp_path / "other.safetensors") != hashes[0]


@pytest.mark.parametrize("name", FILTERS)
def test_a_stage_trains_its_parameters_and_no_others(name: str) -> None:
    filter_ = build(architecture("door", name), seed=0)
    steps = Steps.of(filter_.task, episodes(4))
    filter_.statistics.fit(steps)
    before = {key: value.clone() for key, value in filter_.state_dict().items()}
    trainer = Trainer(filter_, steps, SMOKE, torch.Generator().manual_seed(0), None)
    trainer.end_to_end("weights", list(filter_.get_submodule("weight_model").parameters()), count=2, length=4)
    changed = {key for key, value in filter_.state_dict().items() if not torch.equal(value, before[key])}
    assert changed
    assert all(key.startswith("weight_model.") for key in changed)


@pytest.mark.parametrize("name", FILTERS)
def test_gradients_reach_every_parameter_through_sixteen_steps(name: str) -> None:
    filter_ = build(architecture("door", name), seed=0)
    steps = Steps.of(filter_.task, episodes(4))
    filter_.statistics.fit(steps)
    seen: dict[str, float] = {}
    trainer = Trainer(filter_, steps, SMOKE, torch.Generator().manual_seed(0), None)
    for key, parameter in filter_.named_parameters():
        parameter.register_hook(lambda grad, key=key: seen.__setitem__(key, float(grad.abs().sum())))
    trainer.end_to_end("together", list(filter_.parameters()), count=1, length=16)
    missing = [key for key, _ in filter_.named_parameters() if seen.get(key, 0.0) == 0.0]
    # A bias before a softmax over particles shifts all alike: a likelihood's last one counts only between modalities.
    assert not missing


def test_a_data_set_without_training_episodes_is_refused() -> None:
    held_out = [e for e in episodes() if e.split != "train"]
    with pytest.raises(BadInput, match="no episode of split 'train'"):
        train(architecture("door", "crossmodal-pf"), held_out, data_hash="-", plan=SMOKE)
    with pytest.raises(
        BadInput, match=r"filter 'crosmodal-pf' does not exist\. Available: crossmodal-ekf, crossmodal-pf"
    ):
        architecture("door", "crosmodal-pf")


def test_bad_checkpoint_files(tmp_path: Path) -> None:
    whole = shipped("door", "crossmodal-ekf")
    with pytest.raises(BadInput, match="does not exist"):
        load_checkpoint(tmp_path / "none.safetensors")
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(whole.read_bytes()[:5000])
    with pytest.raises(BadInput, match="not a readable safetensors file"):
        load_checkpoint(cut)
    foreign = tmp_path / "foreign.safetensors"
    from safetensors.torch import save_file

    save_file({"weight": torch.zeros(3)}, foreign)
    with pytest.raises(BadInput, match="not a checkpoint of Beliefscope"):
        load_checkpoint(foreign)
    from safetensors import safe_open

    with safe_open(whole, framework="pt") as file:
        metadata = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
    tensors["statistics.state_mean"] = torch.zeros(5)
    save_file(tensors, foreign, metadata=metadata)
    with pytest.raises(BadInput, match=r"'statistics\.state_mean' is \(5,\), but this architecture has \(3,\)"):
        load_checkpoint(foreign)

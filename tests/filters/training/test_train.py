"""Training in miniature: every stage runs, the same seed gives the same weights, and only what should train does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build, filters_of
from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint, shipped
from beliefscope.filters.models.networks import ImageEncoder
from beliefscope.filters.training.stages import Trainer
from beliefscope.filters.training.train import PLANS, Plan, train

SMOKE = PLANS["smoke"]
NAMES = tuple(filters_of(find_task("door")))


def episodes(count: int = 10) -> list:
    with open_dataset(sample_path("door")) as dataset:
        return [dataset[i] for i in range(count)]


@pytest.mark.parametrize("name", NAMES)
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


def trainer_of(name: str, plan: Plan = SMOKE, seed: int = 0) -> Trainer:
    filter_ = build(architecture("door", name), seed=0)
    some = episodes(9)  # number 8 is for validation
    steps = Steps.of(filter_.task, some)
    filter_.statistics.fit(steps.part(0, 8))
    return Trainer(filter_, steps.part(0, 8), plan, seed, steps.part(8, 9))


@pytest.mark.parametrize("name", NAMES)
def test_each_stage_trains_its_parameters_and_no_others(name: str) -> None:
    trainer = trainer_of(name)
    filter_ = trainer.filter
    allowed = {"dynamics": ("dynamics.",), "weights": ("weight_model.",), "together": ("",), "pictures": ("",)}
    pictures = {k for k, v in filter_.named_modules() if isinstance(v, ImageEncoder)}
    trainer.sets["val"] = None  # or a stage may well keep what it began with
    for stage in trainer.stages():
        before = {key: value.clone() for key, value in filter_.state_dict().items()}
        stage.run()
        changed = {key for key, value in filter_.state_dict().items() if not torch.equal(value, before[key])}
        assert changed, stage.name
        first = stage.name.split(",")[0].split()[0]
        assert all(key.startswith(allowed.get(first, ("",))) for key in changed), stage.name
        seen = {key for key in changed if any(key.startswith(f"{p}.") for p in pictures)}
        # Only the stages that say so may move what looks at pictures: all others remember what it said.
        assert bool(seen) == (first == "pictures" and bool(pictures)), stage.name
        if stage.name == "pictures":
            assert changed == seen
        if stage.name.endswith(" model"):
            assert all(f".{stage.name.removesuffix(' model')}." in key for key in changed)


def test_remembered_pictures_are_what_the_encoders_say() -> None:
    """The same windows, black pictures among them: by number and by picture, the evidence is the same."""
    trainer = trainer_of("crossmodal-ekf")
    trainer.begin("windows")
    seen = trainer.filter.encode(trainer.sample("val", 6, 5))
    with trainer.remembering():
        trainer.begin("windows")
        batch = trainer.sample("val", 6, 5)
        remembered = trainer.filter.encode(batch)
    assert int((batch.observations["image"] == -1).sum()) > 0
    # One convolution's sums in another order.
    torch.testing.assert_close(seen.observation, remembered.observation, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(seen.log_weights, remembered.log_weights, rtol=1e-4, atol=1e-5)


def test_a_shift_moves_object_and_hand_alike_and_nothing_else() -> None:
    trainer = trainer_of("crossmodal-ekf")
    batch = trainer.sample("train", 5, 3)
    moved = trainer.shifted(batch)
    offset = moved.states - batch.states
    assert torch.allclose(offset[..., :2], offset[:1, :, :2].expand(5, 3, 2), atol=1e-6)
    assert float(offset[..., :2].abs().min()) > 1e-5
    assert torch.equal(offset[..., 2], torch.zeros(5, 3))
    for before, after in (
        (batch.observations["haptics"], moved.observations["haptics"]),
        (batch.controls, moved.controls),
        (batch.previous[None], moved.previous[None]),
    ):
        torch.testing.assert_close(after[..., :2] - before[..., :2], offset[: len(before), :, :2], rtol=0, atol=1e-6)
        assert torch.equal(after[..., 2:], before[..., 2:])
    assert torch.equal(moved.observations["image"], batch.observations["image"])


def test_the_best_weights_on_the_validation_set_are_kept() -> None:
    """With steps far too large the loss only grows: the stage must end early, and what it leaves must still be sane."""
    plan = replace(SMOKE, models=40, check=2, patience=3, rate=0.3)
    trainer = trainer_of("haptics-ekf", plan)
    module = trainer.measurement_module("haptics")
    taken = []
    trainer.report = lambda stage, done, count, loss: taken.append(done)

    def error() -> float:
        batch = trainer.sets["val"].windows(torch.arange(800, 900), 1)
        z = module(trainer.filter.observations(batch))[0]
        truth = trainer.filter.statistics.standardise("state", batch.states)
        return float((z - truth).square().mean().detach())

    trainer.model("haptics", module)
    assert len(taken) < 40
    assert error() < 3.0


@pytest.mark.parametrize("name", NAMES)
def test_gradients_reach_every_parameter_through_sixteen_steps(name: str) -> None:
    trainer = trainer_of(name)
    filter_ = trainer.filter
    seen: dict[str, float] = {}
    for key, parameter in filter_.named_parameters():
        parameter.register_hook(lambda grad, key=key: seen.__setitem__(key, float(grad.abs().sum())))
    trainer.end_to_end("together", list(filter_.parameters()), 1, 16, 1e-3, remembered=False)
    missing = [key for key, _ in filter_.named_parameters() if seen.get(key, 0.0) == 0.0]
    # A bias before a softmax over particles shifts all alike: a likelihood's last one counts only between modalities.
    alone = filter_.architecture.kind == "pf" and filter_.architecture.fusion != "unimodal" and len(filter_.names) == 1
    assert not [key for key in missing if not (alone and "measurement_models" in key and key.endswith("head.2.bias"))]


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


def test_a_training_that_was_killed_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    """Killed as every one of its stages ends, in turn, it ends as one that never was; shared parts change nothing."""
    some = episodes(9)
    chosen, partial = architecture("door", "crossmodal-pf"), tmp_path / "x.partial"

    def trained(**options: object) -> str:
        result = train(chosen, some, data_hash="-", plan=SMOKE, seed=5, **options)
        return save_checkpoint(result.filter, "x", {}, tmp_path / "x.safetensors")

    whole = trained()
    reached: list[str] = []

    class Killed(Exception):
        pass

    def kill_in_next_stage(stage: str, done: int, count: int, loss: float) -> None:
        if stage not in reached:
            reached.append(stage)
            raise Killed

    for _ in range(100):
        try:
            resumed = trained(partial=partial, report=kill_in_next_stage)
            break
        except Killed:
            pass
    assert len(reached) > 8
    assert resumed == whole
    assert not partial.exists()
    parts = tmp_path / "parts"
    assert trained(parts=parts) == whole
    assert len(list(parts.iterdir())) == 2
    assert trained(parts=parts) == whole
    # Of another seed it is of no use.
    partial.write_bytes((tmp_path / "x.safetensors").read_bytes())
    assert trained(partial=partial) == whole

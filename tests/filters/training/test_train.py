"""Training with the smoke schedule: determinism, the parameters of each stage, and resuming."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import sample_path
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build, filters_of
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.filters.models.networks import ImageEncoder
from beliefscope.filters.training.plan import PLANS, Plan
from beliefscope.filters.training.stages import ALL_PARAMETERS, IMAGES, Trainer, seed_name
from beliefscope.filters.training.train import measure, train

pytestmark = pytest.mark.slow

SMOKE = PLANS["smoke"]
NAMES = tuple(filters_of(find_task("door")))
FIRST = ("crossmodal-ekf", "feature-pf", "information-ekf", "lstm")
"""Each kind of filter once; the others are tested by ``make check-all`` only."""
KINDS = ("crossmodal-ekf", "crossmodal-pf", "crossmodal-ukf", "information-pf", "lstm", "transformer")
"""Kinds of networks; all but the first two and the last are tested by ``make check-all`` only."""
VAL = 8  # index of the first validation episode
STEPS = 50


@pytest.fixture(scope="module")
def episodes(short_episodes: Callable[..., list[Episode]]) -> list[Episode]:
    """Four training episodes and one validation episode."""
    return short_episodes("door", (0, 1, 2, 3, VAL), STEPS)


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "name", [name if name in (*KINDS[:2], KINDS[-1]) else pytest.param(name, marks=pytest.mark.long) for name in KINDS]
)
def test_same_seed_gives_same_checkpoint(name: str, episodes: list[Episode], tmp_path: Path) -> None:
    def checkpoint_hash(seed: int) -> str:
        # Without validation and test episodes, the filter is not evaluated.
        trained = train(architecture("door", name), episodes[:4], data_hash="-", plan=SMOKE, seed=seed)
        assert all(torch.isfinite(p).all() for p in trained.filter.parameters())
        return save_checkpoint(trained.filter, name, {}, tmp_path / "x.safetensors")

    first = checkpoint_hash(5)
    assert first == checkpoint_hash(5)
    if name == KINDS[0]:
        assert first != checkpoint_hash(6)


def test_the_evaluation_reports_its_progress(episodes: list[Episode]) -> None:
    done: list[float] = []
    results = measure(build(architecture("door", "haptics-ekf"), seed=0).eval(), episodes[4:], progress=done.append)
    assert done == sorted(done)
    assert (len(done) >= len(results), done[-1]) == (True, 1.0)


def test_stages_are_seeded_with_the_names_of_earlier_versions() -> None:
    names = {
        IMAGES: "pictures",
        ALL_PARAMETERS: "pictures too",
        "end to end, 16 steps, validation": "together, 16 steps, validation",
        "image only, validation": "image alone, validation",
        "haptics model": "haptics model",
    }
    assert {name: seed_name(name) for name in names} == names


@pytest.fixture
def make_trainer(episodes: list[Episode]) -> Callable[..., Trainer]:
    def make(name: str, plan: Plan = SMOKE, seed: int = 0) -> Trainer:
        filter_ = build(architecture("door", name), seed=0)
        steps = Steps.from_episodes(filter_.task, episodes)
        filter_.statistics.fit(steps.part(0, 4))
        return Trainer(filter_, steps.part(0, 4), plan, seed, steps.part(4, 5))

    return make


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "name", [name if name in FIRST else pytest.param(name, marks=pytest.mark.long) for name in NAMES]
)
def test_each_stage_trains_only_its_parameters(name: str, make_trainer: Callable[..., Trainer]) -> None:
    trainer = make_trainer(name)
    filter_ = trainer.filter
    prefixes = {"dynamics": "dynamics.", "weights": "weight_model."}
    encoders = {key for key, module in filter_.named_modules() if isinstance(module, ImageEncoder)}
    trainer.sets["val"] = None  # with validation, a stage could end with its initial weights
    for stage in trainer.stages():
        before = {key: value.clone() for key, value in filter_.state_dict().items()}
        stage.run()
        changed = {key for key, value in filter_.state_dict().items() if not torch.equal(value, before[key])}
        assert changed, stage.name
        assert all(key.startswith(prefixes.get(stage.name, "")) for key in changed), stage.name
        in_encoders = {key for key in changed if any(key.startswith(f"{encoder}.") for encoder in encoders)}
        # All other stages use cached features of the image encoders.
        assert bool(in_encoders) == (stage.name in (IMAGES, ALL_PARAMETERS)), stage.name
        if stage.name == IMAGES:
            assert changed == in_encoders
        if stage.name.endswith(" model"):
            assert all(f".{stage.name.removesuffix(' model')}." in key for key in changed)


def test_cached_features_equal_encoder_outputs(make_trainer: Callable[..., Trainer]) -> None:
    """The same windows with image blackouts, by image index and by image."""
    trainer = make_trainer("crossmodal-ekf")
    trainer.seed_generators("windows")
    encoded = trainer.filter.encode(trainer.sample("val", 6, 5))
    with trainer.cached_images():
        trainer.seed_generators("windows")
        batch = trainer.sample("val", 6, 5)
        cached = trainer.filter.encode(batch)
    assert int((batch.observations["image"] == -1).sum()) > 0
    # The convolutions' sums are taken in another order.
    torch.testing.assert_close(encoded.observation, cached.observation, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(encoded.log_weights, cached.log_weights, rtol=1e-4, atol=1e-5)


def test_shift_changes_only_positions(make_trainer: Callable[..., Trainer]) -> None:
    trainer = make_trainer("crossmodal-ekf")
    batch = trainer.sample("train", 5, 3)
    shifted = trainer.shifted(batch)
    offset = shifted.states - batch.states
    assert torch.allclose(offset[..., :2], offset[:1, :, :2].expand(5, 3, 2), atol=1e-6)
    assert float(offset[..., :2].abs().min()) > 1e-5
    assert torch.equal(offset[..., 2], torch.zeros(5, 3))
    for before, after in (
        (batch.observations["haptics"], shifted.observations["haptics"]),
        (batch.controls, shifted.controls),
        (batch.previous[None], shifted.previous[None]),
    ):
        torch.testing.assert_close(after[..., :2] - before[..., :2], offset[: len(before), :, :2], rtol=0, atol=1e-6)
        assert torch.equal(after[..., 2:], before[..., 2:])
    assert torch.equal(shifted.observations["image"], batch.observations["image"])


def test_best_validated_weights_are_kept(make_trainer: Callable[..., Trainer]) -> None:
    """With a learning rate that is far too large the loss only grows: the stage ends early with usable weights."""
    trainer = make_trainer("haptics-ekf", replace(SMOKE, models=40, check=2, patience=3, rate=0.3))
    module = trainer.measurement_module("haptics")
    steps = []
    trainer.report = lambda stage, done, count, loss: steps.append(done)

    def error() -> float:
        batch = trainer.sets["val"].windows(torch.arange(4 * STEPS, 5 * STEPS), 1)
        z = module(trainer.filter.observations(batch))[0]
        truth = trainer.filter.statistics.standardise("state", batch.states)
        return float((z - truth).square().mean().detach())

    before = error()
    trainer.train_model("haptics", module)
    assert len(steps) < 40
    assert error() <= 1.1 * before


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["crossmodal-pf", "feature-ekf", "lstm"])
def test_end_to_end_gradients_reach_every_parameter(name: str, make_trainer: Callable[..., Trainer]) -> None:
    trainer = make_trainer(name)
    filter_ = trainer.filter
    norms: dict[str, float] = {}
    for key, parameter in filter_.named_parameters():
        parameter.register_hook(lambda grad, key=key: norms.__setitem__(key, float(grad.abs().sum())))
    trainer.end_to_end("end to end", list(filter_.parameters()), 1, 16, 1e-3, cached=False)
    assert all(norms.get(key, 0.0) > 0.0 for key, _ in filter_.named_parameters())


def test_data_without_training_episodes_are_rejected(episodes: list[Episode]) -> None:
    with pytest.raises(BadInput, match=r"no episode of split 'train', only of 'val': .* collect door -o"):
        train(architecture("door", "crossmodal-pf"), episodes[4:], data_hash="-", plan=SMOKE)
    with pytest.raises(
        BadInput,
        match=r"filter 'crosmodal-pf' does not exist\. Did you mean crossmodal-pf .*Available: crossmodal-ekf, ",
    ):
        architecture("door", "crosmodal-pf")


def test_invalid_checkpoint_files(tmp_path: Path) -> None:
    source = pretrained_path("door", "crossmodal-ekf")
    with pytest.raises(BadInput, match="does not exist"):
        load_checkpoint(tmp_path / "none.safetensors")
    truncated = tmp_path / "truncated.safetensors"
    truncated.write_bytes(source.read_bytes()[:5000])
    with pytest.raises(BadInput, match="not a readable safetensors file"):
        load_checkpoint(truncated)
    with pytest.raises(BadInput, match="it is an HDF5 file, such as a data set"):
        load_checkpoint(sample_path("door"))
    other = tmp_path / "other.safetensors"
    save_file({"weight": torch.zeros(3)}, other)
    with pytest.raises(BadInput, match=r"FILE\.py:FUNCTION@"):
        load_checkpoint(other)
    with safe_open(source, framework="pt") as file:
        metadata = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
    tensors["statistics.state_mean"] = torch.zeros(5)
    save_file(tensors, other, metadata=metadata)
    with pytest.raises(BadInput, match=r"'statistics\.state_mean' is \(5,\), but this architecture has \(3,\)"):
        load_checkpoint(other)


@pytest.mark.long
def test_interrupted_training_resumes_to_the_same_weights(episodes: list[Episode], tmp_path: Path) -> None:
    """Interrupted once in each stage, with shared modules, or with an unusable partial file: identical weights."""
    partial = tmp_path / "x.partial"

    def checkpoint_hash(**options: object) -> str:
        trained = train(architecture("door", "crossmodal-ekf"), episodes, data_hash="-", plan=SMOKE, seed=5, **options)
        return save_checkpoint(trained.filter, "x", {}, tmp_path / "x.safetensors")

    expected = checkpoint_hash()
    interrupted: list[str] = []

    class Interrupted(Exception):
        pass

    def interrupt_in_next_stage(stage: str, done: int, count: int, loss: float) -> None:
        if stage not in interrupted:
            interrupted.append(stage)
            raise Interrupted

    for _ in range(100):
        try:
            resumed = checkpoint_hash(partial=partial, report=interrupt_in_next_stage)
            break
        except Interrupted:
            pass
    assert len(interrupted) > 8
    assert resumed == expected
    stages = len(interrupted)
    assert checkpoint_hash(partial=partial, report=interrupt_in_next_stage) == expected
    assert len(interrupted) == stages, "no stage is repeated before the result is stored"
    shared = tmp_path / "shared"
    assert checkpoint_hash(shared=shared) == expected
    assert len(list(shared.iterdir())) == 2
    assert checkpoint_hash(shared=shared) == expected
    partial.write_bytes((tmp_path / "x.safetensors").read_bytes())  # of another training
    assert checkpoint_hash(partial=partial) == expected

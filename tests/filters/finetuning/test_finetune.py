"""Fine-tuning: frozen parameters, cached encoders, batches, validation, and resuming."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.filters.finetuning.batch_mix import Mix
from beliefscope.filters.finetuning.finetune import Callbacks, FineTuned, finetune
from beliefscope.filters.finetuning.loop import FilterLoop, Validation, score
from beliefscope.filters.finetuning.module_selection import freeze, named_tensors, select_parameters
from beliefscope.filters.finetuning.report import no_change
from beliefscope.filters.finetuning.settings import FineTune, StepRange
from beliefscope.filters.finetuning.slices import CLEAN, Slice
from beliefscope.filters.models.networks import IMAGES_CHUNK, ImageEncoder
from beliefscope.filters.training import losses
from beliefscope.filters.training.encoder_cache import LazyFeatures, cached_encoders, encode_images, index_images

pytestmark = pytest.mark.slow

DARK = Slice("dark", Faults.parse("blackout=1"), only=("haptics",))
TOUCH = Slice("touch", contact=True)
SMALL = FineTune(
    train=("haptics-only",), mix=((DARK, 1.0), (TOUCH, 1.0)), length=6, windows=6, steps=4, check=2, particles=10
)


def base(name: str = "crossmodal-ekf") -> Checkpoint:
    return load_checkpoint(pretrained_path("push", name))


@pytest.fixture(scope="module")
def episodes(short_episodes: Callable[..., list[Episode]]) -> list[Episode]:
    """Eight training episodes, one validation and one test episode; each of 60 steps."""
    return short_episodes("push", range(10), 60)


def run(episodes: list[Episode], settings: FineTune = SMALL, name: str = "crossmodal-ekf", **more: object) -> FineTuned:
    result = finetune(base(name), episodes, data_hash="-", settings=settings, **more)  # type: ignore[arg-type]
    assert result is not None
    return result


def mix_of(episodes: list[Episode], settings: FineTune, name: str = "crossmodal-ekf") -> Mix:
    filter_ = base(name).filter
    return Mix.from_shares(filter_.task, filter_.names, settings.shares(), episodes, settings.seed)


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("name", "train", "encoders"),
    [
        ("crossmodal-ekf", ("weights-only",), 0),
        ("crossmodal-pf", ("weight_model", "haptics-only"), 1),
        ("crossmodal-ekf", ("all",), 2),
    ],
)
def test_cached_encoders_give_the_same_gradients(
    episodes: list[Episode], name: str, train: tuple[str, ...], encoders: int
) -> None:
    settings = replace(SMALL, train=train)
    filter_ = copy.deepcopy(base(name).filter)
    mix = mix_of(episodes[:2], settings, name)
    trained = select_parameters(filter_, settings.train)

    def gradients(mix: Mix) -> dict[str, torch.Tensor]:
        filter_.zero_grad(set_to_none=True)
        loss = FilterLoop(filter_, trained, settings, mix, mix).step_loss(3)
        loss.backward()
        return {key: p.grad.clone() for key, p in trained.items() if p.grad is not None} | {"loss": loss.detach()}

    filter_.requires_grad_(True)
    expected = gradients(mix)
    freeze(filter_, trained)
    (steps,), images = index_images([mix.steps])
    calls: list[int] = []
    for module in filter_.modules():
        if type(module).__name__ == "ImageEncoder":
            module.register_forward_hook(lambda *_: calls.append(1))
    with cached_encoders(filter_, images):
        gradients(mix.with_steps(steps))  # encodes the images of the step
        calls.clear()
        cached = gradients(mix.with_steps(steps))
    # One call for each trained encoder, none for frozen ones.
    assert len(calls) == encoders
    assert expected.keys() == cached.keys()
    # Some gradients are zero but for rounding, such as that of a likelihood's constant.
    rounding = 1e-6 * max(float(value.abs().max()) for value in expected.values())
    for key, value in expected.items():
        # Float32 sums in another order, through six steps of a filter: relative to the largest entry.
        tolerance = max(1e-4 * float(value.abs().max()), rounding)
        torch.testing.assert_close(cached[key], value, rtol=1e-3, atol=tolerance)
    assert len(expected) > 5
    assert not any(hasattr(m, "table") and (m.table is not None or m.images is not None) for m in filter_.modules())


def test_features_are_computed_on_first_use_with_the_same_bits(episodes: list[Episode]) -> None:
    filter_ = copy.deepcopy(base("crossmodal-ekf").filter)
    encoder = next(module for module in filter_.modules() if isinstance(module, ImageEncoder))
    images = index_images([mix_of(episodes[:2], SMALL).steps])[1]["image"]
    images = images[: 2 * IMAGES_CHUNK + 20]
    expected = encode_images(filter_, "image", encoder, images)
    encoded: list[int] = []
    encoder.register_forward_hook(lambda module, arguments, output: encoded.append(len(output)))
    features = LazyFeatures(filter_, "image", encoder, images)
    last = torch.tensor([[len(images) - 1], [len(images) - 2]])
    assert torch.equal(features[last], expected[last])
    assert encoded == [IMAGES_CHUNK], "one block, which is whole"
    assert torch.equal(features[torch.arange(len(images))], expected)
    assert encoded == [IMAGES_CHUNK] * 3


def test_image_indices_refer_to_distinct_images(episodes: list[Episode]) -> None:
    mix = mix_of(episodes[:3], SMALL)
    (steps,), images = index_images([mix.steps])
    assert torch.equal(images["image"][steps.observations["image"]], mix.steps.observations["image"])
    assert len(images["image"].flatten(1).unique(dim=0)) == len(images["image"])
    assert steps.observations["image"].unique_consecutive().cummax(0).values.diff().max() == 1, "in order of first use"
    dark = steps.part(3, 6).rows()
    assert len(steps.observations["image"][dark].unique()) == 1, "all blacked-out images are one"
    assert torch.equal(steps.observations["haptics"], mix.steps.observations["haptics"])


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("name", "train", "scale", "rate"),
    [
        ("crossmodal-ekf", "haptics-only", 1.3, 1e-5),
        ("crossmodal-pf", "noise-only", 0.5, 1e-3),
    ],
)
def test_only_selected_parameters_change(
    episodes: list[Episode], name: str, train: str, scale: float, rate: float, tmp_path: Path
) -> None:
    before = base(name)
    file = pretrained_path("push", name).read_bytes()
    with torch.no_grad():
        for parameter in select_parameters(before.filter, [train]).values():
            parameter.mul_(scale)  # room for improvement
    settings = replace(SMALL, train=(train,), rate=rate, steps=6)
    result = finetune(before, episodes, data_hash="-", settings=settings)
    assert result is not None
    assert result.record["best_step"] > 0
    old, new = named_tensors(before.filter), named_tensors(result.filter)
    changed = {key for key in old if not torch.equal(old[key], new[key])}
    assert changed
    assert changed <= set(select_parameters(before.filter, [train]))
    assert pretrained_path("push", name).read_bytes() == file
    record = json.loads(json.dumps(result.record))
    assert record["base"]["hash"] == before.hash
    assert FineTune.from_json(record["base"]["settings"]) == settings
    assert record["frozen"]["before"] == record["frozen"]["after"]
    assert record["frozen"]["tensors"] == len(old) - len(select_parameters(before.filter, [train]))
    assert set(record["parts"]) == set(select_parameters(before.filter, [train]))
    assert {key for key, (_, change, _) in record["parts"].items() if change > 0} == changed
    assert all(gradient > 0 for gradient, _, _ in record["parts"].values())
    assert [validation["step"] for validation in record["validations"]] == [0, 2, 4, 6]
    assert set(record["held_out"]["after"]) == {"clean", "dark", "touch"}
    save_checkpoint(result.filter, before.name, result.record, tmp_path / "finetuned.safetensors")
    assert load_checkpoint(tmp_path / "finetuned.safetensors").record == record


@pytest.mark.long
def test_interrupted_run_resumes_to_the_same_weights(episodes: list[Episode], tmp_path: Path) -> None:
    """Paused before each step, or killed in each step, the result is identical to an uninterrupted run."""
    settings = replace(SMALL, train=("haptics-only", "weights-only"), steps=3, check=2)
    expected = run(episodes, settings)
    partial = tmp_path / "x.partial"

    class Killed(Exception):
        pass

    def check_same(result: FineTuned) -> None:
        for key, value in named_tensors(expected.filter).items():
            assert torch.equal(value, named_tensors(result.filter)[key]), key
        for key in ("validations", "parts", "best_step", "steps", "held_out"):
            assert result.record[key] == expected.record[key], key

    pause_at = 0
    steps: list[int] = []
    result = None
    while result is None:
        pause_at += 1
        result = finetune(
            base(),
            episodes,
            data_hash="-",
            settings=settings,
            callbacks=Callbacks(
                report=lambda step, count, loss: steps.append(step),
                stop=lambda at=pause_at: len(steps) == at,  # type: ignore[misc]
            ),
            partial=partial,
        )
    assert steps == [1, 2, 3], "no step runs twice"
    check_same(result)
    again = run(episodes, settings, callbacks=Callbacks(lambda step, count, loss: steps.append(step)), partial=partial)
    check_same(again)
    assert steps == [1, 2, 3], "a complete run is not repeated before its result is stored"
    partial.unlink()

    killed_at: list[int] = []

    def kill(step: int, count: int, loss: float) -> None:
        if step not in killed_at:
            killed_at.append(step)
            raise Killed

    while True:
        try:
            result = run(episodes, settings, callbacks=Callbacks(kill), partial=partial)
            break
        except Killed:
            pass
    assert killed_at == [1, 2, 3]
    check_same(result)
    partial.write_bytes(b"not a state")
    check_same(run(episodes, settings, partial=partial))


@pytest.mark.long
def test_run_without_improvement_returns_the_base_weights(episodes: list[Episode]) -> None:
    result = run(episodes, replace(SMALL, rate=10.0, steps=20, check=2, patience=3))
    assert (result.record["best_step"], result.record["steps"]) == (0, 6)
    old, new = named_tensors(base().filter), named_tensors(result.filter)
    assert all(torch.equal(old[key], new[key]) for key in old)
    assert result.record["held_out"]["before"] == result.record["held_out"]["after"]


def test_l2_sp_is_a_proximal_step(episodes: list[Episode]) -> None:
    """Without a gradient, a step shrinks the distance to the base weights by the factor 1 / (1 + rate l2_sp)."""
    settings = replace(SMALL, l2_sp=50.0, rate=1e-2, likelihood_weight=0.0, steps=100)
    filter_ = copy.deepcopy(base().filter)
    trained = select_parameters(filter_, ["weight_model.output"])
    freeze(filter_, trained)
    loop = FilterLoop(filter_, trained, settings, mix_of(episodes[:1], settings), mix_of(episodes[:1], settings))
    with torch.no_grad():
        for p in trained.values():
            p.add_(0.5)
    loop.step_loss = lambda step: 0.0 * sum(p.sum() for p in trained.values())  # type: ignore[method-assign, assignment]
    loop.step()
    for name, p in trained.items():
        torch.testing.assert_close(p - loop.base[name], torch.full_like(p, 0.5 / 1.5), rtol=1e-5, atol=1e-6)


def test_windows_have_the_requested_shares_and_steps(episodes: list[Episode]) -> None:
    settings = replace(SMALL, mix=((DARK, 3.0), (TOUCH, 1.0)), clean_weight=0.2)
    shares = settings.shares()
    assert [round(share, 6) for share in shares.values()] == [0.2, 0.6, 0.2]
    first = int(episodes[1].contact.argmax())
    events = {1: [StepRange(1, first, first + 10)]}
    filter_ = base().filter
    mix = Mix.from_shares(filter_.task, filter_.names, shares, episodes[:3], 0, events)
    starts = mix.starts(8)
    windows = mix.windows(mix.sample_starts(starts, 40, torch.Generator().manual_seed(0)), 8)
    batch = windows.batch
    assert {name: where.stop - where.start for name, where in windows.parts.items()} == {
        "clean": 8,
        "dark": 24,
        "touch": 8,
    }
    for name, where in windows.parts.items():
        total = float(windows.weight[:, where].sum())
        assert total == pytest.approx({"clean": 0.2, "dark": 0.6, "touch": 0.2}[name], rel=1e-5)
        assert bool((windows.weight[:, where].sum(0) > 0).all()), "each window has a step of its slice"
    dark, touch = (windows.parts[name] for name in ("dark", "touch"))
    assert int(batch.observations["image"][:, dark].max()) == 0
    assert int(batch.observations["image"][:, touch].max()) > 0
    assert bool(batch.contact[:, touch][windows.weight[:, touch] > 0].all())
    assert windows.present is not None
    assert windows.present[:, dark].unique(dim=1).tolist()[0] == [[False, True]]
    assert bool(windows.present[:, touch].all())
    # Events restrict the slices, but not clean data.
    event_states = torch.from_numpy(episodes[1].states[first : first + 10]).float()
    for where in (dark, touch):
        for state in batch.states[:, where][windows.weight[:, where] > 0]:
            assert bool((event_states == state).all(-1).any())
    assert mix.starts(8)[0].numel() == 3 * (60 - 8 + 1)
    with pytest.raises(BadInput, match="slice 'touch' has no matching step in windows of 8 steps"):
        Mix.from_shares(
            filter_.task, filter_.names, {TOUCH: 1.0}, [replace(episodes[0], contact=episodes[0].contact & False)], 0
        ).starts(8)


def test_uniformly_weighted_loss_is_the_mean(episodes: list[Episode]) -> None:
    filter_ = base().filter
    mix = mix_of(episodes[:2], replace(SMALL, mix=()))
    windows = mix.windows(mix.sample_starts(mix.starts(10), 5, torch.Generator().manual_seed(0)), 10)
    evidence = filter_.encode(windows.batch)
    plain, weighted = (
        losses.through_filter(filter_, evidence, windows.batch, torch.Generator().manual_seed(1), 10, 0.05, weight)
        for weight in (None, windows.weight)
    )
    torch.testing.assert_close(plain, weighted, rtol=1e-5, atol=1e-6)


def test_score_combines_error_and_likelihood() -> None:
    before = Validation(0, None, {"a": {"error": 2.0, "nll": 1.0}, "b": {"error": 1.0, "nll": None}})
    after = Validation(1, 0.0, {"a": {"error": 1.0, "nll": 3.0}, "b": {"error": 1.5, "nll": None}})
    assert score(before, before, {"a": 0.4, "b": 0.6}, 0.1) == pytest.approx(1.0)
    assert score(after, before, {"a": 0.4, "b": 0.6}, 0.1) == pytest.approx(0.4 * (0.5 + 0.1 * 2) + 0.6 * 1.5)


def test_episodes_with_events_are_trained_on_and_not_evaluated_on(episodes: list[Episode]) -> None:
    held_out = episodes[9]
    assert held_out.split == "test"
    result = run(episodes, replace(SMALL, events=(StepRange(9, 10, 30),), mix=((DARK, 1.0),), steps=1))
    assert result.record["episodes"] == {"train": 9, "val": 1, "test": 1}
    assert result.record["base"]["settings"]["events"] == ["9:10-30"]


def test_settings_survive_json_and_invalid_ones_are_rejected(episodes: list[Episode]) -> None:
    full = replace(
        SMALL, events=(StepRange(3), StepRange(2, 1, 9)), rates=(("weight_model", 1e-4),), freeze=("*.log_noise",)
    )
    assert FineTune.from_json(json.loads(json.dumps(full.to_json()))) == full
    assert FineTune.from_json({}) == FineTune()
    assert list(FineTune().shares()) == [CLEAN]
    for values, message in (
        ({"step": 3}, "fine-tuning setting 'step' does not exist"),
        ({"steps": "3"}, "setting 'steps' of a fine-tuning run is '3'"),
        ({"steps": 0}, "not a whole number from 1 to"),
        ({"train": "all"}, "setting 'train'"),
        ({"clean_weight": 1.5}, "not from 0 to 1"),
        ({"rate": 0}, "rate of a fine-tuning run"),
        ({"mix": [{"slice": {"name": "clean"}, "share": 1}]}, "slice names must be unique"),
        ({"events": ["x"]}, "not EPISODE or EPISODE:FIRST-LAST"),
        ([], "not an object"),
    ):
        with pytest.raises(BadInput, match=message):
            FineTune.from_json(values)
    with pytest.raises(BadInput, match="modality 'touch' of slice 'x' does not exist"):
        run(episodes, replace(SMALL, mix=((Slice("x", only=("touch",)), 1.0),)))
    with pytest.raises(BadInput, match="Episode 99 is not in the data, which has episodes 0 to 9"):
        run(episodes, replace(SMALL, events=(StepRange(99),)))
    with pytest.raises(BadInput, match="begins after its episode's 60 steps"):
        run(episodes, replace(SMALL, events=(StepRange(9, 70),)))
    with pytest.raises(BadInput, match="event 9:5-70 ends after its episode's 60 steps"):
        run(episodes, replace(SMALL, events=(StepRange(9, 5, 70),)))


def test_rates_and_windows_are_checked_before_any_evaluation(
    episodes: list[Episode], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("beliefscope.filters.finetuning.finetune.validate", lambda *_: pytest.fail("evaluated"))
    with pytest.raises(BadInput, match=r"rate nope=0\.1 matches no trained parameter: "):
        run(episodes, replace(SMALL, rates=(("nope", 0.1),)))
    with pytest.raises(BadInput, match="windows of 9999 steps are longer than every training episode: 60 steps"):
        run(episodes, replace(SMALL, length=9999))


def test_a_run_that_ruins_the_weights_keeps_the_base_and_says_so(episodes: list[Episode]) -> None:
    record = run(episodes, replace(SMALL, rate=100.0)).record
    assert record["best_step"] == 0
    assert no_change(record).startswith("No change: the base checkpoint was best. Try ")
    assert "a learning rate other than 100" in no_change(record)
    assert not no_change(record | {"best_step": 2})
    assert not no_change(record | {"noise_factor": 1.2})

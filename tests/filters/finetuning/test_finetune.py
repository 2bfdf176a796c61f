"""Fine-tuning by its laws: what is frozen stays, what is looked up is right, and a run goes on where it was cut."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, shipped
from beliefscope.filters.finetuning.batch_mix import Mix, Moment
from beliefscope.filters.finetuning.finetune import FineTune, FineTuned, finetune
from beliefscope.filters.finetuning.loop import Look, Tuning, score
from beliefscope.filters.finetuning.module_selection import chosen, freeze, tensors_of
from beliefscope.filters.finetuning.slices import NOMINAL, Slice
from beliefscope.filters.training import losses
from beliefscope.filters.training.encoder_cache import numbered, recalling

DARK = Slice("dark", Faults.parse("blackout=1"), only=("haptics",))
TOUCH = Slice("touch", contact=True)
SMALL = FineTune(
    train=("haptics-only",), mix=((DARK, 1.0), (TOUCH, 1.0)), length=6, windows=6, steps=4, check=2, particles=10
)


def parent(name: str = "crossmodal-ekf") -> Checkpoint:
    return load_checkpoint(shipped("push", name))


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    """Ten episodes: eight to train on, one to validate on, one to test on; each of 60 steps."""
    with open_dataset(sample_path("push")) as data:
        return [part(data[i], 60) for i in range(10)]


def part(episode: Episode, steps: int) -> Episode:
    return replace(
        episode,
        states=episode.states[:steps],
        controls=episode.controls[:steps],
        contact=episode.contact[:steps],
        qpos=episode.qpos[:steps],
        observations={key: value[:steps] for key, value in episode.observations.items()},
    )


def tuned(
    episodes: list[Episode], settings: FineTune = SMALL, name: str = "crossmodal-ekf", **more: object
) -> FineTuned:
    found = finetune(parent(name), episodes, data_hash="-", settings=settings, **more)  # type: ignore[arg-type]
    assert found is not None
    return found


def mix_of(episodes: list[Episode], settings: FineTune, name: str = "crossmodal-ekf") -> Mix:
    filter_ = parent(name).filter
    return Mix.of(filter_.task, filter_.names, settings.shares(), episodes, settings.seed)


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
@pytest.mark.parametrize(
    ("train", "encoders"), [(("weights-only",), 0), (("weight_model", "haptics-only"), 1), (("all",), 2)]
)
def test_what_is_looked_up_gives_the_same_gradients(
    episodes: list[Episode], name: str, train: tuple[str, ...], encoders: int
) -> None:
    """With frozen encoders' features looked up, and with everything in the graph: the same loss and gradients."""
    settings = replace(SMALL, train=train)
    filter_ = copy.deepcopy(parent(name).filter)
    mix = mix_of(episodes[:2], settings, name)
    trained = chosen(filter_, settings.train)
    found: list[dict[str, torch.Tensor]] = []

    def gradients(of: Mix) -> None:
        filter_.zero_grad(set_to_none=True)
        loss = Tuning(filter_, trained, settings, of, of).loss_of(3)
        loss.backward()
        found.append(
            {key: p.grad.clone() for key, p in trained.items() if p.grad is not None} | {"loss": loss.detach()}
        )

    filter_.requires_grad_(True)
    gradients(mix)
    freeze(filter_, trained)
    (steps,), pictures = numbered([mix.steps])
    calls: list[int] = []
    for module in filter_.modules():
        if type(module).__name__ == "ImageEncoder":
            module.register_forward_hook(lambda *_: calls.append(1))
    with recalling(filter_, pictures):
        calls.clear()
        gradients(mix.on(steps))
    # The batch's pictures go through a trained encoder in one call, and through a frozen one in none.
    assert len(calls) == encoders
    assert found[0].keys() == found[1].keys()
    for key, value in found[0].items():
        # Sums of float32 in another order, through six steps of a filter: relative to the largest entry.
        torch.testing.assert_close(found[1][key], value, rtol=1e-3, atol=1e-4 * float(value.abs().max()))
    assert len(found[0]) > 5
    assert not any(hasattr(m, "table") and (m.table is not None or m.pictures is not None) for m in filter_.modules())


def test_numbers_stand_for_pictures_and_black_ones_are_one(episodes: list[Episode]) -> None:
    mix = mix_of(episodes[:3], SMALL)
    (steps,), pictures = numbered([mix.steps])
    assert torch.equal(pictures["image"][steps.observations["image"]], mix.steps.observations["image"])
    assert len(pictures["image"].flatten(1).unique(dim=0)) == len(pictures["image"])
    dark = steps.part(3, 6).rows()
    assert len(steps.observations["image"][dark].unique()) == 1
    assert torch.equal(steps.observations["haptics"], mix.steps.observations["haptics"])


@pytest.mark.parametrize(
    ("name", "train", "spoiled", "rate"),
    [
        ("crossmodal-ekf", "haptics-only", 1.3, 1e-5),
        ("crossmodal-ekf", "noise-only", 1.3, 1e-5),
        ("crossmodal-pf", "noise-only", 0.5, 1e-3),
    ],
)
def test_only_what_is_trained_moves(
    episodes: list[Episode], name: str, train: str, spoiled: float, rate: float, tmp_path: Path
) -> None:
    before = parent(name)
    file = shipped("push", name).read_bytes()
    with torch.no_grad():
        for parameter in chosen(before.filter, [train]).values():
            parameter.mul_(spoiled)  # something to mend, so that some step does better than none
    settings = replace(SMALL, train=(train,), rate=rate, steps=6)
    found = finetune(before, episodes, data_hash="-", settings=settings)
    assert found is not None
    assert found.record["best_step"] > 0
    was, now = tensors_of(before.filter), tensors_of(found.filter)
    moved = {key for key in was if not torch.equal(was[key], now[key])}
    assert moved
    assert moved <= set(chosen(before.filter, [train]))
    assert shipped("push", name).read_bytes() == file
    record = json.loads(json.dumps(found.record))
    assert record["parent"]["hash"] == before.hash
    assert FineTune.of(record["parent"]["settings"]) == settings
    assert record["frozen"]["before"] == record["frozen"]["after"]
    assert record["frozen"]["tensors"] == len(was) - len(chosen(before.filter, [train]))
    assert set(record["parts"]) == set(chosen(before.filter, [train]))
    assert {key for key, (_, change, _) in record["parts"].items() if change > 0} == moved
    assert all(gradient > 0 for gradient, _, _ in record["parts"].values())
    assert [one["step"] for one in record["looks"]] == [0, 2, 4, 6]
    assert set(record["held_out"]["after"]) == {"nominal", "dark", "touch"}
    save_checkpoint(found.filter, before.name, found.record, tmp_path / "child.safetensors")
    assert load_checkpoint(tmp_path / "child.safetensors").record == record


def test_a_run_goes_on_where_it_was_cut(episodes: list[Episode], tmp_path: Path) -> None:
    """Paused before each of its steps, or killed in each, it ends in the bits of one that never was."""
    settings = replace(SMALL, train=("haptics-only", "weights-only"), steps=3, check=2)
    whole = tuned(episodes, settings)
    partial = tmp_path / "x.partial"

    class Killed(Exception):
        pass

    def same(found: FineTuned) -> None:
        for key, value in tensors_of(whole.filter).items():
            assert torch.equal(value, tensors_of(found.filter)[key]), key
        for key in ("looks", "parts", "best_step", "steps", "held_out"):
            assert found.record[key] == whole.record[key], key
        assert not partial.exists()

    paused = 0
    steps: list[int] = []

    def stop() -> bool:
        return len(steps) == paused

    while True:
        paused += 1
        found = finetune(
            parent(),
            episodes,
            data_hash="-",
            settings=settings,
            report=lambda step, count, loss: steps.append(step),
            stop=stop,
            partial=partial,
        )
        if found is not None:
            break
    assert steps == [1, 2, 3], "no step is done twice"
    same(found)

    def kill(step: int, count: int, loss: float) -> None:
        if step not in reached:
            reached.append(step)
            raise Killed

    reached: list[int] = []
    while True:
        try:
            found = tuned(episodes, settings, report=kill, partial=partial)
            break
        except Killed:
            pass
    assert reached == [1, 2, 3]
    same(found)
    # What another run left is of no use to this one.
    partial.write_bytes(b"not a state")
    same(tuned(episodes, settings, partial=partial))


def test_a_run_that_only_spoils_gives_back_the_parent(episodes: list[Episode]) -> None:
    found = tuned(episodes, replace(SMALL, rate=10.0, steps=20, check=2, patience=3))
    assert (found.record["best_step"], found.record["steps"]) == (0, 6)
    was, now = tensors_of(parent().filter), tensors_of(found.filter)
    assert all(torch.equal(was[key], now[key]) for key in was)
    assert found.record["held_out"]["before"] == found.record["held_out"]["after"]


def test_the_pull_is_the_proximal_step(episodes: list[Episode]) -> None:
    """Where the loss has no gradient, a step shrinks the way from the parent by 1 / (1 + rate pull), exactly so."""
    settings = replace(SMALL, pull=50.0, rate=1e-2, likelihood_weight=0.0, steps=100)
    filter_ = copy.deepcopy(parent().filter)
    trained = chosen(filter_, ["weight_model.output"])
    freeze(filter_, trained)
    tuning = Tuning(filter_, trained, settings, mix_of(episodes[:1], settings), mix_of(episodes[:1], settings))
    with torch.no_grad():
        for p in trained.values():
            p.add_(0.5)
    tuning.loss_of = lambda step: 0.0 * sum(p.sum() for p in trained.values())  # type: ignore[method-assign, assignment]
    tuning.step()
    for name, p in trained.items():
        torch.testing.assert_close(p - tuning.parent[name], torch.full_like(p, 0.5 / 1.5), rtol=1e-5, atol=1e-6)


def test_windows_hold_what_counts_in_the_given_shares(episodes: list[Episode]) -> None:
    settings = replace(SMALL, mix=((DARK, 3.0), (TOUCH, 1.0)), nominal=0.2)
    shares = settings.shares()
    assert [round(share, 6) for share in shares.values()] == [0.2, 0.6, 0.2]
    first = int(episodes[1].contact.argmax())
    moments = {1: [Moment(1, first, first + 10)]}
    filter_ = parent().filter
    mix = Mix.of(filter_.task, filter_.names, shares, episodes[:3], 0, moments)
    starts = mix.starts(8)
    windows = mix.windows(mix.drawn(starts, 40, torch.Generator().manual_seed(0)), 8)
    batch = windows.batch
    assert {name: where.stop - where.start for name, where in windows.parts.items()} == {
        "nominal": 8,
        "dark": 24,
        "touch": 8,
    }
    for name, where in windows.parts.items():
        total = float(windows.weight[:, where].sum())
        assert total == pytest.approx({"nominal": 0.2, "dark": 0.6, "touch": 0.2}[name], rel=1e-5)
        assert bool((windows.weight[:, where].sum(0) > 0).all()), "each window holds a step that counts"
    dark, touch = (windows.parts[name] for name in ("dark", "touch"))
    assert int(batch.observations["image"][:, dark].max()) == 0
    assert int(batch.observations["image"][:, touch].max()) > 0
    assert bool(batch.contact[:, touch][windows.weight[:, touch] > 0].all())
    assert windows.present is not None
    assert windows.present[:, dark].unique(dim=1).tolist()[0] == [[False, True]]
    assert bool(windows.present[:, touch].all())
    # Of the slices only the chosen moment counts, of nominal data everything.
    chosen_states = torch.from_numpy(episodes[1].states[first : first + 10]).float()
    for where in (dark, touch):
        for state in batch.states[:, where][windows.weight[:, where] > 0]:
            assert bool((chosen_states == state).all(-1).any())
    assert mix.starts(8)[0].numel() == 3 * (60 - 8 + 1)
    with pytest.raises(BadInput, match="slice 'touch' has no step that counts in 1 episodes"):
        Mix.of(
            filter_.task, filter_.names, {TOUCH: 1.0}, [replace(episodes[0], contact=episodes[0].contact & False)], 0
        ).starts(8)


def test_the_weighted_loss_is_the_mean_where_all_count_alike(episodes: list[Episode]) -> None:
    filter_ = parent().filter
    mix = mix_of(episodes[:2], replace(SMALL, mix=()))
    windows = mix.windows(mix.drawn(mix.starts(10), 5, torch.Generator().manual_seed(0)), 10)
    evidence = filter_.encode(windows.batch)
    plain, weighted = (
        losses.through_filter(filter_, evidence, windows.batch, torch.Generator().manual_seed(1), 10, 0.05, weight)
        for weight in (None, windows.weight)
    )
    torch.testing.assert_close(plain, weighted, rtol=1e-5, atol=1e-6)


def test_the_score_weighs_error_and_likelihood() -> None:
    before = Look(0, None, {"a": {"error": 2.0, "nll": 1.0}, "b": {"error": 1.0, "nll": None}})
    after = Look(1, 0.0, {"a": {"error": 1.0, "nll": 3.0}, "b": {"error": 1.5, "nll": None}})
    assert score(before, before, {"a": 0.4, "b": 0.6}, 0.1) == pytest.approx(1.0)
    assert score(after, before, {"a": 0.4, "b": 0.6}, 0.1) == pytest.approx(0.4 * (0.5 + 0.1 * 2) + 0.6 * 1.5)


def test_chosen_episodes_are_learned_from_and_not_measured_on(episodes: list[Episode]) -> None:
    held_out = episodes[9]
    assert held_out.split == "test"
    found = tuned(episodes, replace(SMALL, moments=(Moment(9, 10, 30),), mix=((DARK, 1.0),), steps=1))
    assert found.record["episodes"] == {"train": 9, "val": 1, "test": 1}
    assert found.record["parent"]["settings"]["moments"] == ["9:10-30"]


def test_settings_travel_and_wrong_ones_are_refused(episodes: list[Episode]) -> None:
    full = replace(
        SMALL, moments=(Moment(3), Moment(2, 1, 9)), rates=(("weight_model", 1e-4),), freeze=("*.log_noise",)
    )
    assert FineTune.of(json.loads(json.dumps(full.to_json()))) == full
    assert FineTune.of({}) == FineTune()
    assert list(FineTune().shares()) == [NOMINAL]
    for values, words in (
        ({"step": 3}, "setting of a fine-tuning 'step' does not exist"),
        ({"steps": "3"}, "setting 'steps' of a fine-tuning is '3'"),
        ({"steps": 0}, "not a whole number from 1 to"),
        ({"train": "all"}, "setting 'train'"),
        ({"nominal": 1.5}, "not from 0 to 1"),
        ({"rate": 0}, "rate of a fine-tuning"),
        ({"mix": [{"slice": {"name": "nominal"}, "share": 1}]}, "two slices have one name"),
        ({"moments": ["x"]}, "not EPISODE or EPISODE:FIRST-LAST"),
        ([], "not an object"),
    ):
        with pytest.raises(BadInput, match=words):
            FineTune.of(values)
    with pytest.raises(BadInput, match="modality of slice 'x' 'touch' does not exist"):
        tuned(episodes, replace(SMALL, mix=((Slice("x", only=("touch",)), 1.0),)))
    with pytest.raises(BadInput, match="Episode 99 is not in the data, which has episodes 0 to 9"):
        tuned(episodes, replace(SMALL, moments=(Moment(99),)))
    with pytest.raises(BadInput, match="begins after its episode's 60 steps"):
        tuned(episodes, replace(SMALL, moments=(Moment(9, 70),)))

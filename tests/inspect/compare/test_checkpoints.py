"""The report of a change: what laws it keeps, and that it finds damage where damage was done."""

from __future__ import annotations

import copy
import hashlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.inspect.compare.checkpoints import CheckpointComparison, compare_checkpoints
from beliefscope.inspect.compare.effects import Difference, differences
from beliefscope.inspect.compare.modules import heard
from beliefscope.inspect.statistics.episode_sums import measures_of, spread
from beliefscope.inspect.statistics.measures import position_error
from beliefscope.inspect.trace import trace
from beliefscope.inspect.traces.replay import Edit, Replay

EPISODES = (9, 19, 29, 39, 49, 59)
"""Of those held out: enough for intervals."""

EKF = load_checkpoint(shipped("door", "crossmodal-ekf"))
PF = load_checkpoint(shipped("door", "crossmodal-pf"))


@pytest.fixture(scope="module")
def data() -> Iterator[Dataset]:
    with open_dataset(sample_path("door")) as episodes:
        yield episodes


def altered(checkpoint: Checkpoint, change: Callable[[Filter], None]) -> Checkpoint:
    """A child whose weights were changed in place."""
    filter_ = copy.deepcopy(checkpoint.filter)
    with torch.no_grad():
        change(filter_)
    parts = {
        "virtual_sensors.haptics.state.bias": [4.0, 3.0, 1.0],
        "virtual_sensors.haptics.state.weight": [3.0, 0.0, 1.0],
    }
    record = {"parent": {"hash": checkpoint.hash, "settings": {}}, "parts": parts}
    return replace(checkpoint, filter=filter_, hash=hashlib.sha256(b"child").hexdigest(), record=record)


def off_by_haptics(filter_: Filter) -> None:
    """A plain mistake: haptics says that the hinge is three standard deviations of its place farther along x."""
    filter_.get_parameter("virtual_sensors.haptics.state.bias")[0] += 3.0


HURT = altered(EKF, off_by_haptics)


@cache
def changed(there: bool) -> CheckpointComparison:
    """From the shipped filter to the hurt one and back."""
    pair = (EKF, HURT) if there else (HURT, EKF)
    with open_dataset(sample_path("door")) as episodes:
        return compare_checkpoints(*pair, {i: episode_of(episodes, i, 60) for i in EPISODES})


@pytest.mark.parametrize("checkpoint", [EKF, PF], ids=["ekf", "pf"])
def test_a_filter_has_not_changed_from_itself(checkpoint: Checkpoint, data: Dataset) -> None:
    short = [episode_of(data, index, 40) for index in EPISODES]
    found = compare_checkpoints(checkpoint, altered(checkpoint, lambda _: None), short, particles=20)
    assert all(d.effect == d.low == d.high == 0.0 for d in found.differences)
    assert not found.mended()
    assert not found.damaged()
    assert not found.moments
    assert all(m.same and m.weights in (0.0, pytest.approx(math.nan, nan_ok=True)) for m in found.modules)
    assert not any(m.drift > 0.0 for m in found.modules)
    assert "exactly what" in found.verdict


def episode_of(data: Dataset, index: int, steps: int) -> Episode:
    """The first steps of an episode."""
    e = data[index]
    return replace(
        e,
        states=e.states[:steps],
        controls=e.controls[:steps],
        contact=e.contact[:steps],
        qpos=e.qpos[:steps],
        observations={key: value[:steps] for key, value in e.observations.items()},
    )


def test_swapping_the_two_turns_every_sign() -> None:
    there, back = changed(True), changed(False)
    assert len(there.differences) == len(back.differences) > 0
    for a, b in zip(there.differences, back.differences, strict=True):
        assert (a.slice, a.measure, a.before, a.after) == (b.slice, b.measure, b.after, b.before)
        assert [a.effect, a.low, a.high] == pytest.approx([-b.effect, -b.high, -b.low], rel=1e-9, abs=1e-12)
        assert (a.mended, a.damaged) == (b.damaged, b.mended)


def test_planted_damage_is_found_where_it_was_planted() -> None:
    found = changed(True)
    worst = found.damaged()[0]
    assert (worst.slice, worst.measure) == ("haptics alone", "hinge_x")
    assert worst.after > 2.0 * worst.before
    alone = [d for d in found.differences if d.slice == "image alone"]
    assert alone
    assert all(d.effect == 0.0 for d in alone)
    assert "; damages haptics alone: hinge x " in found.verdict
    assert found.moments[0].slice == "haptics alone"
    assert changed(False).verdict.startswith("Mends haptics alone: hinge x ")


def verdict_of(low: float, effect: float, high: float) -> str:
    """Where all that changed is one error, by so much."""
    one = Difference("contact", "position", "m", 0.01, 0.01 * math.exp(effect), effect, low, high)
    return replace(changed(True), differences=(one,)).verdict


def test_the_verdict_says_no_more_than_the_intervals() -> None:
    assert verdict_of(-0.01, 0.001, 0.01) == "Mends nothing beyond 2 %; damages nothing beyond 2 %."
    assert verdict_of(-0.01, 0.10, 0.20) == (
        "Mends nothing beyond 2 %; damages nothing for certain, most likely contact: position 1 -> 1.11 cm (+10.5 %, "
        "95 % interval -0.995 to +22.1)."
    )
    assert verdict_of(-0.10, 0.01, 0.01).startswith("Mends nothing for certain; damages nothing beyond 2 %.")
    assert verdict_of(0.05, 0.10, 0.20).startswith("Mends nothing beyond 2 %; damages contact: position 1 -> 1.11 cm")
    assert verdict_of(-0.20, -0.10, -0.05).startswith("Mends contact: position 1 -> 0.905 cm (-9.52 %, ")


def test_moments_are_where_the_error_rose_most() -> None:
    moments = changed(True).moments
    rises = [m.after - m.before for m in moments]
    assert rises == sorted(rises, reverse=True)
    assert min(rises) > 0.0
    assert all(m.first <= m.step <= m.last and m.episode in EPISODES for m in moments)


def test_a_moment_of_one_modality_alone_is_what_the_edit_of_its_link_shows(data: Dataset) -> None:
    moment = changed(True).moments[0]
    episode = episode_of(data, moment.episode, 60)
    replay = Replay(HURT, trace(HURT, episode, moment.episode))
    edited = replay.edited(Edit(0, moment.last + 1, weights={moment.only[0]: 1.0}))
    # Beta one-hot is the modality alone to rounding, and a trace keeps single precision.
    assert position_error(edited)[moment.step, -1] == pytest.approx(moment.after, rel=1e-3)


def test_what_was_frozen_is_proved_by_its_hash_and_what_was_not_drifts() -> None:
    found = changed(True)
    modules = {m.name: m for m in found.modules}
    assert set(found.frozen) >= {"statistics", "dynamics", "virtual_sensors.image", "weight_model"}
    assert found.child
    sensor = modules["virtual_sensors.haptics.state"]
    bias, weight = (EKF.filter.get_parameter(f"{sensor.name}.{name}") for name in ("bias", "weight"))
    assert not sensor.same
    assert sensor.weights == pytest.approx(3.0 / float(torch.cat([bias, weight.flatten()]).norm()), rel=1e-5)
    assert sensor.drift > 0.0
    assert sensor.gradient == modules["virtual_sensors.haptics"].gradient == pytest.approx(5.0)  # 3 and 4 of its parts
    assert math.isnan(modules["dynamics"].gradient)
    assert modules["virtual_sensors.haptics.encoders"].drift == 0.0
    assert modules["weight_model"].drift == modules["dynamics"].drift == 0.0


def test_listening_leaves_nothing_behind(data: Dataset) -> None:
    batch = spread([data[9]], PF.task, 8)
    outputs = heard(PF.filter, batch)
    assert outputs["measurement_models.image.head"][0].isfinite().all()
    assert not any(m._forward_hooks for m in PF.filter.modules())


def test_numbers_are_those_of_evaluate(data: Dataset) -> None:
    black = Slice("black", Faults.parse("blackout=0.4"))
    episodes = [data[i] for i in EPISODES[:2]]
    found = compare_checkpoints(EKF, PF, episodes, slices=[black], particles=20, seed=3)
    for name, faults, only in (
        ("nominal", Faults(), None),
        ("black", black.faults, None),
        ("haptics alone", Faults(), "haptics"),
    ):
        rows = {d.measure: d for d in found.differences if d.slice == name}
        for checkpoint, side in ((EKF, "before"), (PF, "after")):
            metrics = evaluate(checkpoint.filter, episodes, faults=faults, only=only, particles=20, seed=3)
            got = {f"{d.measure}_{d.shown[2]}": d.shown[side == "after"] for d in rows.values() if d.is_error}
            # Doubles here, singles there until the sums.
            assert got == pytest.approx(metrics.rmse, rel=1e-4)
            beliefs = [getattr(rows[key], side) for key in ("nll", "nees", "coverage95")]
            assert beliefs == pytest.approx([metrics.nll, metrics.nees, metrics.coverage95], rel=1e-3)
    assert "too few" in found.verdict
    assert not found.mended()
    assert not found.damaged()


def test_intervals_cover() -> None:
    """Pairs of episodes with a known ratio of expected squared errors: 95 % intervals hold it about so often."""
    rng, task = np.random.default_rng(0), EKF.task
    position = [m for m in measures_of(task) if m.name == "position"]
    n, episodes, trials, truth = len(task.components), 40, 200, 0.5 * math.log(1.5)
    held = 0
    for _ in range(trials):
        hard = rng.gamma(4.0, 0.25, episodes)
        sums = np.ones((episodes, 2, 1, n + 4 + 19))
        sums[:, 0, 0, n + 1] = hard * rng.gamma(8.0, 1 / 8, episodes)
        sums[:, 1, 0, n + 1] = 1.5 * hard * rng.gamma(8.0, 1 / 8, episodes)
        (found,) = differences(sums, ["all"], position)
        held += found.low <= truth <= found.high
    # Percentile intervals of 40 episodes are a little narrow: 92 to 95 %; 0.88 is three standard errors below 0.945.
    assert 0.88 < held / trials < 0.99


def test_a_slice_without_a_step_is_left_out(data: Dataset) -> None:
    free = [replace(episode_of(data, i, 40), contact=np.zeros(40, bool)) for i in EPISODES[:5]]
    found = compare_checkpoints(EKF, HURT, free)
    assert "contact" not in {d.slice for d in found.differences}
    assert next(p for p in found.parts if p.slice.name == "contact").steps == 0


def test_a_filter_without_covariance_is_compared_by_its_errors(data: Dataset) -> None:
    from beliefscope.filters.catalog import architecture, build

    filters = [build(architecture("door", "lstm"), seed) for seed in (0, 1)]
    a, b = (Checkpoint(f.eval().requires_grad_(False), "lstm", str(i), {}) for i, f in enumerate(filters))
    found = compare_checkpoints(a, b, [episode_of(data, i, 34) for i in EPISODES[:5]])
    assert {d.measure for d in found.differences} == {"position", "hinge_x", "hinge_y", "angle"}
    assert any("image alone" in line for line in found.left_out)
    json.dumps(found.views(), allow_nan=False)


def test_what_cannot_be_compared_is_refused(data: Dataset) -> None:
    with pytest.raises(BadInput, match="'door' and 'push'"):
        compare_checkpoints(EKF, load_checkpoint(shipped("push", "crossmodal-ekf")), data)
    with pytest.raises(BadInput, match="Available: image, haptics"):
        compare_checkpoints(EKF, HURT, data, slices=[Slice("a", only=("touch",))])


def test_it_is_shown_as_every_diagnostic_is() -> None:
    found = changed(True)
    views = json.loads(json.dumps(found.views(), allow_nan=False))
    assert [t["title"] for t in views["tables"]][:2] == ["Damaged, the worst first", "Errors by slice (RMSE)"]
    assert all(len(row) == len(t["columns"]) for t in views["tables"] for row in t["rows"])
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["verdict"] == found.verdict
    assert [axes.get_title(loc="left") for axes in found.plot().axes][:2] == [
        "Position by slice",
        "Calibration: nominal",
    ]

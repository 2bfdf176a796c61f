"""Comparison of checkpoints: symmetry, planted regressions, intervals and module changes."""

from __future__ import annotations

import copy
import hashlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.external.load import load_external
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.inspect.compare.checkpoints import CheckpointComparison, compare_checkpoints
from beliefscope.inspect.compare.effects import Difference, differences
from beliefscope.inspect.compare.modules import module_outputs
from beliefscope.inspect.statistics.episode_sums import measures_of, sample_steps
from beliefscope.inspect.statistics.measures import main_error
from beliefscope.inspect.trace import trace
from beliefscope.inspect.traces.replay import Intervention, Replay

pytestmark = pytest.mark.slow

EPISODES = (9, 19, 29, 39, 49, 109, 129, 141)
"""Held-out episodes: from step 30 to 40, five have steps with contact and five without, enough for intervals."""

EXAMPLES = Path(__file__).parents[3] / "examples"


@cache
def ekf() -> Checkpoint:
    return load_checkpoint(pretrained_path("door", "crossmodal-ekf"))


@cache
def pf() -> Checkpoint:
    return load_checkpoint(pretrained_path("door", "crossmodal-pf"))


@pytest.fixture(scope="module")
def data() -> Iterator[Dataset]:
    with open_dataset(sample_path("door")) as episodes:
        yield episodes


def finetuned(checkpoint: Checkpoint, change: Callable[[Filter], None]) -> Checkpoint:
    """A fine-tuned copy of a checkpoint whose weights are changed in place."""
    filter_ = copy.deepcopy(checkpoint.filter)
    with torch.no_grad():
        change(filter_)
    parts = {
        "virtual_sensors.haptics.state.bias": [4.0, 3.0, 1.0],
        "virtual_sensors.haptics.state.weight": [3.0, 0.0, 1.0],
    }
    record = {"base": {"hash": checkpoint.hash, "settings": {}}, "parts": parts}
    return replace(checkpoint, filter=filter_, hash=hashlib.sha256(b"finetuned").hexdigest(), record=record)


def bias_haptics(filter_: Filter) -> None:
    """Bias the haptics sensor by three standard deviations of hinge x."""
    filter_.get_parameter("virtual_sensors.haptics.state.bias")[0] += 3.0


@cache
def biased_ekf() -> Checkpoint:
    return finetuned(ekf(), bias_haptics)


@cache
def comparison(forward: bool) -> CheckpointComparison:
    """Comparison of the built-in and the biased filter, in both directions."""
    pair = (ekf(), biased_ekf()) if forward else (biased_ekf(), ekf())
    with open_dataset(sample_path("door")) as episodes:
        return compare_checkpoints(*pair, {i: episode_of(episodes, i, 60) for i in EPISODES})


@pytest.mark.first(1)
@pytest.mark.parametrize("load", [ekf, pf], ids=["ekf", "pf"])
def test_filter_is_identical_to_itself(load: Callable[[], Checkpoint], data: Dataset) -> None:
    checkpoint = load()
    short = [episode_of(data, index, 40) for index in EPISODES]
    result = compare_checkpoints(checkpoint, finetuned(checkpoint, lambda _: None), short, particles=20)
    assert all(d.effect == d.low == d.high == 0.0 for d in result.differences)
    assert not result.improvements()
    assert not result.regressions()
    assert not result.events
    assert all(m.unchanged and m.weights in (0.0, pytest.approx(math.nan, nan_ok=True)) for m in result.modules)
    assert not any(m.drift > 0.0 for m in result.modules)
    assert "is identical to" in result.verdict


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


@pytest.mark.long
def test_swapping_checkpoints_changes_signs() -> None:
    forward, backward = comparison(True), comparison(False)
    assert len(forward.differences) == len(backward.differences) > 0
    for a, b in zip(forward.differences, backward.differences, strict=True):
        assert (a.slice, a.measure, a.before, a.after) == (b.slice, b.measure, b.after, b.before)
        assert [a.effect, a.low, a.high] == pytest.approx([-b.effect, -b.high, -b.low], rel=1e-9, abs=1e-12)
        assert (a.improved, a.regressed) == (b.regressed, b.improved)


def test_planted_regression_is_found() -> None:
    result = comparison(True)
    worst = result.regressions()[0]
    assert (worst.slice, worst.measure) == ("haptics only", "hinge_x")
    assert worst.after > 2.0 * worst.before
    image_only = [d for d in result.differences if d.slice == "image only"]
    assert image_only
    assert all(d.effect == 0.0 for d in image_only)
    assert "; regressed: haptics only: hinge x " in result.verdict
    assert result.events[0].slice == "haptics only"
    assert comparison(False).verdict.startswith("Improved: haptics only: hinge x ")


def test_beliefs_change_in_nats_and_points() -> None:
    result = comparison(True)
    by_measure = {d.measure: d for d in result.differences if d.slice == "haptics only"}
    n = len(find_task("door").components)
    nll, coverage = by_measure["nll"], by_measure["coverage95"]
    assert nll.change == pytest.approx([n * x for x in (nll.effect, nll.low, nll.high)])
    assert coverage.change[0] == pytest.approx(coverage.after - coverage.before)
    assert coverage.before > coverage.after  # the biased filter is overconfident
    title, rows = "Regressions", {}
    for table in result.tables():
        if table.title == title:
            rows = {(row[0], row[1]): row[3] for row in table.rows}
    assert rows["haptics only", "NLL"] == f"{nll.after - nll.before:+.3g} nats"
    assert rows["haptics only", "95 % coverage"] == f"{100 * (coverage.after - coverage.before):+.1f} points"


def verdict_of(low: float, effect: float, high: float) -> str:
    """Verdict for a single changed error."""
    difference = Difference(
        "contact", "position", "cm", 100.0, 0.01, 0.01 * math.exp(effect), effect, low, high, (0.0, 0.0, 0.0)
    )
    return replace(comparison(True), differences=(difference,)).verdict


def test_verdict_follows_the_intervals() -> None:
    assert verdict_of(-0.01, 0.001, 0.01) == "Improved: nothing by more than 2 %; regressed: nothing by more than 2 %."
    assert verdict_of(-0.01, 0.10, 0.20) == (
        "Improved: nothing by more than 2 %; regressed: nothing significant; largest change contact: position "
        "1 -> 1.11 cm (+10.5 %, "
        "95 % interval -0.995 to +22.1)."
    )
    assert verdict_of(-0.10, 0.01, 0.01).startswith(
        "Improved: nothing significant; regressed: nothing by more than 2 %."
    )
    assert verdict_of(0.05, 0.10, 0.20).startswith(
        "Improved: nothing by more than 2 %; regressed: contact: position 1 -> 1.11 cm"
    )
    assert verdict_of(-0.20, -0.10, -0.05).startswith("Improved: contact: position 1 -> 0.905 cm (-9.52 %, ")


def test_clean_data_come_before_faults_and_single_modalities() -> None:
    base = comparison(True)
    effects = {"haptics only": 0.5, "blackout 0.8": 0.3, "contact": 0.2, "clean": 0.1}
    changes = tuple(
        Difference(name, "position", "cm", 1.0, 1.0, math.exp(e), e, e - 0.01, e + 0.01, (e, e - 0.01, e + 0.01))
        for name, e in effects.items()
    )
    result = replace(base, differences=changes)
    assert [d.slice for d in result.regressions()] == ["clean", "contact", "blackout 0.8", "haptics only"]
    assert "; regressed: clean: position 1 -> 1.11 cm" in result.verdict
    assert result.regressed_slices() == ["clean", "contact", "blackout 0.8"]
    assert replace(base, differences=changes[:1]).regressed_slices() == []


def test_events_are_sorted_by_error_increase() -> None:
    events = comparison(True).events
    increases = [m.after - m.before for m in events]
    assert increases == sorted(increases, reverse=True)
    assert min(increases) > 0.0
    assert all(m.first <= m.step <= m.last and m.episode in EPISODES for m in events)


def test_single_modality_event_equals_the_edit_of_its_link(data: Dataset) -> None:
    event = comparison(True).events[0]
    episode = episode_of(data, event.episode, 60)
    replay = Replay(biased_ekf(), trace(biased_ekf(), episode, event.episode))
    counterfactual = replay.with_intervention(Intervention(0, event.last + 1, weights={event.only[0]: 1.0}))
    # A one-hot beta equals a single modality up to rounding.
    assert main_error(counterfactual)[event.step, -1] == pytest.approx(event.after, rel=1e-3)


def test_frozen_modules_are_verified_by_hash() -> None:
    result = comparison(True)
    modules = {m.name: m for m in result.modules}
    assert set(result.frozen) >= {"statistics", "dynamics", "virtual_sensors.image", "weight_model"}
    assert result.finetuned
    sensor = modules["virtual_sensors.haptics.state"]
    bias, weight = (ekf().filter.get_parameter(f"{sensor.name}.{name}") for name in ("bias", "weight"))
    assert not sensor.unchanged
    assert sensor.weights == pytest.approx(3.0 / float(torch.cat([bias, weight.flatten()]).norm()), rel=1e-5)
    assert sensor.drift > 0.0
    assert sensor.gradient == modules["virtual_sensors.haptics"].gradient == pytest.approx(5.0)  # norm of 3 and 4
    assert math.isnan(modules["dynamics"].gradient)
    assert modules["virtual_sensors.haptics.encoders"].drift == 0.0
    assert modules["weight_model"].drift == modules["dynamics"].drift == 0.0


def test_output_hooks_are_removed(data: Dataset) -> None:
    batch = sample_steps([data[9]], pf().task, 8)
    outputs = module_outputs(pf().filter, batch)
    assert outputs["measurement_models.image.head"][0].isfinite().all()
    assert not any(m._forward_hooks for m in pf().filter.modules())


def test_numbers_equal_evaluate(data: Dataset) -> None:
    black = Slice("black", Faults.parse("blackout=0.4"))
    episodes = [data[i] for i in EPISODES[:2]]
    result = compare_checkpoints(ekf(), pf(), episodes, slices=[black], particles=20, seed=3)
    for name, faults, only in (
        ("clean", Faults(), None),
        ("black", black.faults, None),
        ("haptics only", Faults(), "haptics"),
    ):
        rows = {d.measure: d for d in result.differences if d.slice == name}
        for checkpoint, side in ((ekf(), "before"), (pf(), "after")):
            metrics = evaluate(checkpoint.filter, episodes, faults=faults, only=only, particles=20, seed=3)
            errors = {f"{d.measure}_{d.display[2]}": d.display[side == "after"] for d in rows.values() if d.is_error}
            # Double precision here, single precision in evaluate.
            assert errors == pytest.approx(metrics.rmse, rel=1e-4)
            beliefs = [getattr(rows[key], side) for key in ("nll", "nees", "coverage95")]
            assert beliefs == pytest.approx([metrics.nll, metrics.nees, metrics.coverage95], rel=1e-3)
    assert result.verdict == "No verdict: too few episodes (2; at least 5 needed)."
    assert not result.improvements()
    assert not result.regressions()


@pytest.mark.long
def test_values_do_not_depend_on_the_number_of_processes(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("beliefscope.filters.evaluate.BLOCK", 2)
    members = {index: episode_of(data, index, 40) for index in EPISODES[:5]}
    serial, parallel = (compare_checkpoints(pf(), ekf(), members, particles=20, workers=n).to_dict() for n in (1, 2))
    assert serial == parallel


def test_interval_coverage() -> None:
    """95 % intervals for pairs of episodes with a known ratio of expected squared errors."""
    rng, task = np.random.default_rng(0), ekf().task
    position = [m for m in measures_of(task) if m.name == "position"]
    n, episodes, trials, expected = len(task.components), 40, 50, 0.5 * math.log(1.5)
    covered = 0
    for _ in range(4):  # batches of trials as slices limit memory
        hard = rng.gamma(4.0, 0.25, (episodes, trials))
        sums = np.ones((episodes, 2, trials, n + 4 + 19))
        sums[:, 0, :, n + 1] = hard * rng.gamma(8.0, 1 / 8, (episodes, trials))
        sums[:, 1, :, n + 1] = 1.5 * hard * rng.gamma(8.0, 1 / 8, (episodes, trials))
        results = differences(sums, [str(trial) for trial in range(trials)], position)
        covered += sum(result.low <= expected <= result.high for result in results)
    # Percentile intervals of 40 episodes cover 92 to 95 %; 0.88 is three standard errors below 0.945.
    assert 0.88 < covered / 200 < 0.99


def test_slice_without_steps_is_omitted(data: Dataset) -> None:
    episodes = [replace(episode_of(data, i, 40), contact=np.zeros(40, bool)) for i in EPISODES[:5]]
    result = compare_checkpoints(ekf(), biased_ekf(), episodes)
    assert "contact" not in {d.slice for d in result.differences}
    assert next(p for p in result.slices if p.slice.name == "contact").steps == 0


def test_filter_without_covariance_is_compared_by_errors(data: Dataset) -> None:
    from beliefscope.filters.catalog import architecture, build

    filters = [build(architecture("door", "lstm"), seed) for seed in (0, 1)]
    a, b = (Checkpoint(f.eval().requires_grad_(False), "lstm", str(i), {}) for i, f in enumerate(filters))
    result = compare_checkpoints(a, b, [episode_of(data, i, 34) for i in EPISODES[:5]])
    assert {d.measure for d in result.differences} == {"position", "hinge_x", "hinge_y", "angle"}
    assert any("image only" in line for line in result.left_out)
    json.dumps(result.views(), allow_nan=False)


def test_external_filters_are_compared(data: Dataset) -> None:
    """The errors are those of ``evaluate``; a modality that is used alone replaces the readings of the others."""
    own = load_external(f"{EXAMPLES / '04_own_filter.py'}:build", "door")
    episodes = [episode_of(data, i, 60) for i in EPISODES]
    result = compare_checkpoints(own, ekf(), episodes)
    by_slice = {(d.slice, d.measure): d for d in result.differences}
    for i, checkpoint in enumerate((own, ekf().filter)):
        metrics = evaluate(checkpoint, episodes)
        assert by_slice["clean", "position"].display[i] == pytest.approx(metrics.rmse["position_cm"], rel=1e-4)
        assert by_slice["clean", "angle"].display[i] == pytest.approx(metrics.rmse["angle_deg"], rel=1e-4)
    # The example does not use the image.
    haptics, clean = by_slice["haptics only", "position"], by_slice["clean", "position"]
    assert haptics.display[0] == clean.display[0]
    assert haptics.display[1] > clean.display[1]
    assert by_slice["image only", "position"].display[0] > clean.display[0]
    assert not result.modules
    assert "Modules" not in {table.title for table in result.tables()}
    itself = compare_checkpoints(own, own, episodes[:5])
    assert "identical" in itself.verdict


def test_incomparable_checkpoints_are_refused(data: Dataset) -> None:
    with pytest.raises(BadInput, match="'door' and 'push'"):
        compare_checkpoints(ekf(), load_checkpoint(pretrained_path("push", "crossmodal-ekf")), data)
    with pytest.raises(BadInput, match="Available: image, haptics"):
        compare_checkpoints(ekf(), biased_ekf(), data, slices=[Slice("a", only=("touch",))])


def test_views_and_figure() -> None:
    result = comparison(True)
    views = json.loads(json.dumps(result.views(), allow_nan=False))
    assert [t["title"] for t in views["tables"]][:2] == ["Regressions", "Errors by slice (RMSE)"]
    assert all(len(row) == len(t["columns"]) for t in views["tables"] for row in t["rows"])
    explained = {t["title"]: t["note"].partition(" ")[0] for t in views["tables"] if t["note"]}
    assert explained == {"Regressions": "change:", "Beliefs by slice": "effect"}
    assert "NLL: difference / number of state components" in "\n".join(map(str, result.tables())).replace("\n  ", " ")
    assert json.loads(json.dumps(result.to_dict(), allow_nan=False))["verdict"] == result.verdict
    assert [axes.get_title(loc="left") for axes in result.plot().axes][:2] == [
        "Position by slice",
        "Calibration: clean",
    ]

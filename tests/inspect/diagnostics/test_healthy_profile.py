"""Healthy profiles: false alarms and power by simulation, the file format, and the pretrained files."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.inspect.diagnosis.test_external_dynamics import SENSORS, TASK, Cart

import beliefscope as bs
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.diagnostics.healthy_comparison import SINGLE_SIGNIFICANCE, Comparison, compare
from beliefscope.inspect.diagnostics.healthy_profile import (
    SUFFIX,
    HealthyProfile,
    find_profile,
    pretrained_reference,
    profile_document,
)
from beliefscope.inspect.healthy import measure_profile, sensor_record
from beliefscope.inspect.statistics.reference_images import measure_reference

NAMES = [f"nees/{layer}/{phase}" for layer in ("image", "haptics", "fused") for phase in ("all", "contact")]
NAMES += [f"weight/image/{phase}" for phase in ("all", "contact")]


def trajectories(count: int, rng: np.random.Generator, factor: float = 1.0) -> list[dict[str, float]]:
    """Statistics with log-normal spread between trajectories, dependent, and missing in some of them."""
    common = rng.normal(size=(count, 1))
    values = np.exp(0.6 * (common + rng.normal(size=(count, len(NAMES)))))
    values[:, :6] *= factor
    missing = rng.random(values.shape) < 0.2
    return [
        {name: float(v) for name, v, gone in zip(NAMES, row, hidden, strict=True) if not gone}
        for row, hidden in zip(values, missing, strict=True)
    ]


def profile(rows: list[dict[str, float]]) -> HealthyProfile:
    columns = {name: np.array([row.get(name, np.nan) for row in rows]) for name in NAMES}
    return HealthyProfile("simulated", len(rows), None, columns)


@pytest.mark.long
@pytest.mark.parametrize("count", [1, 5, 20])
def test_healthy_trajectories_rarely_raise_an_alarm(count: int) -> None:
    rng = np.random.default_rng(count)
    alarms = [bool(compare(profile(trajectories(100, rng)), trajectories(count, rng)).alarms) for _ in range(150)]
    # A rate of 2 % gives more than 9 of 150 with a probability of 0.1 %.
    assert sum(alarms) <= 9


def test_overconfidence_raises_an_alarm() -> None:
    rng = np.random.default_rng(0)
    reference = profile(trajectories(100, rng))
    results = [compare(reference, trajectories(5, rng, factor=9.0)) for _ in range(20)]
    assert sum(bool(result.alarms) for result in results) >= 19
    first = results[0]
    assert first.sentence.startswith("Alarm, compared with the healthy record of 100 episodes: NEES/n of ")
    assert all(alarm.statistic.startswith("nees/") for result in results for alarm in result.alarms)
    assert first.alarms[0].value > first.alarms[0].high


@pytest.mark.slow
def test_one_verdict_over_20_seeds() -> None:
    rng = np.random.default_rng(1)
    reference = profile(trajectories(100, rng))
    for factor, alarm in ((1.0, False), (9.0, True)):
        tested = trajectories(5, rng, factor)
        verdicts = {tuple(d.statistic for d in compare(reference, tested, seed).alarms) for seed in range(20)}
        assert len(verdicts) == 1
        assert bool(verdicts.pop()) is alarm


def test_p_value_of_one_trajectory_is_its_rank() -> None:
    rows = [{"nees/fused/all": value} for value in np.exp(np.random.default_rng(2).normal(size=99))]
    reference = HealthyProfile("", 99, None, {"nees/fused/all": np.array([row["nees/fused/all"] for row in rows])})
    (largest,) = compare(reference, [{"nees/fused/all": 1e6}]).deviations
    assert largest.p_value == pytest.approx(0.01)
    assert largest.alarm
    (middle,) = compare(reference, [{"nees/fused/all": 1.0}]).deviations
    assert middle.p_value > 0.5
    small = HealthyProfile("", 40, None, {"nees/fused/all": reference.statistics["nees/fused/all"][:40]})
    result = compare(small, [{"nees/fused/all": 1e6}])
    assert result.alarms == ()
    assert result.sentence == "Too few episodes (1; at least 2 needed) to compare with the healthy record."


def test_one_deviating_trajectory_is_unusual_but_no_alarm_in_words() -> None:
    healthy = np.random.default_rng(7).normal(0.0, 0.05, 99)
    reference = HealthyProfile("", 99, None, {"autocorrelation/haptics hinge_y/all": healthy})
    single, repeated = (compare(reference, count * [{"autocorrelation/haptics hinge_y/all": 0.9}]) for count in (1, 5))
    subject = "autocorrelation at lag 1 of the innovations of haptics (hinge y) is 0.9"
    compared = f"compared with the healthy record of 99 episodes: {subject}"
    assert single.sentence.startswith(f"Unusual episode (as up to 1 in 50 healthy ones), {compared}")
    assert repeated.sentence.startswith(f"Alarm, {compared}")


def test_order_of_trajectories_is_irrelevant() -> None:
    rng = np.random.default_rng(3)
    reference, tested = profile(trajectories(60, rng)), trajectories(5, rng)
    first, second = compare(reference, tested), compare(reference, tested[::-1])
    key = [(d.statistic, round(d.value, 9), d.p_value) for d in sorted(first.deviations, key=lambda d: d.statistic)]
    assert key == [
        (d.statistic, round(d.value, 9), d.p_value) for d in sorted(second.deviations, key=lambda d: d.statistic)
    ]


def test_no_alarm_reads_well() -> None:
    rng = np.random.default_rng(4)
    result = compare(profile(trajectories(60, rng)), trajectories(5, rng))
    assert isinstance(result, Comparison)
    assert result.sentence == "No alarm: within the healthy record of 60 episodes."
    assert {row[0] for row in result.table().rows} >= {"NEES/n of fused", "effective weight of image in contact"}


def test_json_round_trip() -> None:
    reference = replace(profile(trajectories(30, np.random.default_rng(5))), steps=(90, 100), task="boat")
    again = HealthyProfile.from_json(json.loads(json.dumps(reference.to_json(), allow_nan=False)))
    assert (again.data, again.steps, again.task) == (reference.data, (90, 100), "boat")
    for name in NAMES:
        np.testing.assert_allclose(again.statistics[name], reference.statistics[name], rtol=5e-3)


def test_profiles_of_format_1_have_no_reference() -> None:
    document = profile(trajectories(12, np.random.default_rng(8))).to_json()
    del document["reference"]
    again = HealthyProfile.from_json(document | {"format": 1})
    assert again.reference is None
    assert set(again.statistics) == set(NAMES)


def test_records_of_format_2_lack_the_dynamics_of_external_filters() -> None:
    """These were statistics of predictions from estimates."""
    names = ("dynamics slope/x/all", "process noise/x/all", "nees/fused/all")
    new = HealthyProfile("simulated", 3, None, {name: np.arange(3.0) for name in names}).to_json()
    adapter = bs.Adapter(Cart(), batched=False, modalities=tuple(SENSORS), initial_std=(0.02, 0.02))
    external, own = bs.load_filter(adapter, TASK, name="cart"), load_checkpoint(pretrained_path("door", "image-ekf"))
    old = new | {"format": 2}
    for checkpoint, document, expected in ((external, old, names[2:]), (external, new, names), (own, old, names)):
        object.__setattr__(checkpoint, "healthy_profile", document)  # a checkpoint is frozen
        found = find_profile("cart", "cart", checkpoint.hash, checkpoint)
        assert found is not None
        assert tuple(found.statistics) == expected


@pytest.mark.long
@pytest.mark.slow
def test_a_measured_profile_is_that_of_new_episodes() -> None:
    """Statistics of images are measured with references that the episode is not part of."""
    checkpoint = load_checkpoint(PRETRAINED / "push-image-ekf.safetensors")
    with open_dataset("datasets/samples/push.h5") as data:
        episodes = [data[i] for i in range(140, 152)]
    done: list[float] = []
    training = replace(episodes[0], split="train")
    document = measure_profile(checkpoint.filter, checkpoint.name, [*episodes, training], "", progress=done.append)
    assert done == sorted(done)
    assert done[-1] == 1.0
    assert document is not None
    measured = HealthyProfile.from_json(json.loads(json.dumps(document, allow_nan=False)))
    assert measured.episodes == 12
    assert measured.reference is not None
    assert measured.reference.image.shape == (32, 32)
    own, others = (measure_reference(chosen) for chosen in (episodes, [e for i, e in enumerate(episodes) if i % 4]))
    name = "hand offset/image x/all"
    values = [sensor_statistics(episodes[0], reference)[name] for reference in (own, others)]
    assert measured.statistics[name][0] == pytest.approx(values[1], rel=5e-3)
    assert abs(values[0]) < abs(values[1])


@pytest.mark.parametrize(
    "change",
    [
        {"format": 9},
        {"reference": {"key": "image"}},
        {"episodes": 3},
        {"statistics": {"nees": [1.0]}},
        {"statistics": {"nees/fused/all": "abc"}},
        {"statistics": None},
        {"steps": [100]},
    ],
)
def test_malformed_profiles_are_refused(change: dict[str, Any]) -> None:
    document = profile(trajectories(12, np.random.default_rng(6))).to_json()
    with pytest.raises(BadInput, match="healthy record"):
        HealthyProfile.from_json(document | change)


@pytest.mark.slow
def test_pretrained_profiles_belong_to_their_checkpoints() -> None:
    paths = sorted(PRETRAINED.glob(f"*{SUFFIX}"))
    assert paths
    for path in paths:
        checkpoint = load_checkpoint(path.with_name(path.name.removesuffix(SUFFIX) + ".safetensors"))
        document = json.loads(path.read_text())
        assert document["checkpoint"] == checkpoint.hash
        stored_profile = find_profile(checkpoint.task.name, checkpoint.name, checkpoint.hash, None)
        assert stored_profile is not None
        assert stored_profile.episodes >= 50
        assert math.isfinite(np.nanmean(stored_profile.statistics["nees/fused/all"]))
        assert find_profile(checkpoint.task.name, checkpoint.name, "other", None) is None
        used = find_profile(checkpoint.task.name, checkpoint.name, checkpoint.hash, checkpoint)
        assert used is not None  # that of the file, not an earlier one in the header
        assert used.statistics.keys() == stored_profile.statistics.keys()
        assert used.reference is not None
        assert used.reference.hand is not None or used.reference.object is not None
        if checkpoint.kind == "pf":
            assert "ess//all" in stored_profile.statistics


def test_the_profile_of_a_new_checkpoint_is_in_its_header(tmp_path: Any) -> None:
    base = load_checkpoint(PRETRAINED / "door-image-ekf.safetensors")
    document = profile(trajectories(12, np.random.default_rng(7))).to_json()
    path = tmp_path / "new.safetensors"
    save_checkpoint(base.filter, base.name, base.record, path, document)
    checkpoint = load_checkpoint(path)
    assert checkpoint.record == base.record
    stored_profile = find_profile("door", base.name, checkpoint.hash, checkpoint)
    assert stored_profile is not None
    assert stored_profile.to_json() == document


def test_single_trace_alarms_need_a_large_profile() -> None:
    assert SINGLE_SIGNIFICANCE >= 1.0 / (50 + 1)
    assert [entry.name for entry in DIAGNOSTICS.values() if entry.statistics] == ["weights", "consistency", "particles"]


def test_a_run_without_common_statistics_raises_no_alarm() -> None:
    """A live run of a few steps has none yet."""
    profile = HealthyProfile("simulated", 20, None, {NAMES[0]: np.ones(20)})
    for tested in ([], [{}], [{"other/fused/all": 1.0}]):
        assert not compare(profile, tested).alarms


@pytest.mark.long
@pytest.mark.slow
def test_included_images_replace_those_of_the_episodes() -> None:
    """They are of the same camera: statistics of new episodes agree with those compared with the episodes' own."""
    with open_dataset("datasets/samples/push.h5") as data:
        task, episodes = data.task, [data[i] for i in range(140, 152)]
    images = pretrained_reference(task)
    assert images is not None
    own, included = (sensor_record(episodes, reference) for reference in (None, images))
    assert included.reference is images
    for name in ("shift/image x/all", "hand offset/image x/all", "brightness/image/all"):  # pixels; ratio
        a, b = (np.array([row[name] for row in record.rows]) for record in (own, included))
        assert np.nanmean(a) == pytest.approx(np.nanmean(b), abs=0.25)  # of 9 episodes, and of 120
    assert pretrained_reference(replace(task, name="unknown")) is None


def test_the_loss_of_all_readings_is_an_alarm_although_healthy_episodes_lose_many() -> None:
    rng = np.random.default_rng(1)
    columns = {"black/image/all": rng.beta(4.0, 6.0, 120)}
    assert 0.7 < columns["black/image/all"].max() < 0.9
    lossy = HealthyProfile("simulated", 120, None, columns)
    lost, many = (compare(lossy, [{"black/image/all": share}]) for share in (1.0, 0.7))
    assert bool(lost.alarms)
    assert not many.alarms
    assert lost.deviations[0].t > 3.0 * many.deviations[0].t, "the last readings count most"


@pytest.mark.parametrize("name", ["missing", "crossmodal-ekf/../crossmodal-ekf", "../pretrained/door-crossmodal-ekf"])
def test_only_names_of_pretrained_filters_have_a_file(name: str) -> None:
    """Names come from files of other programs."""
    hash_ = load_checkpoint(pretrained_path("door", "crossmodal-ekf")).hash
    assert profile_document("door", "crossmodal-ekf", hash_, None) is not None
    assert profile_document("door", name, hash_, None) is None

"""Diagnosis of filters with planted faults, against a healthy profile of fresh episodes."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

import beliefscope as bs
from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.belief import Belief, Evidence
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.open_filter import open_filter
from beliefscope.inspect.diagnosis.case import (
    Case,
    affected_episodes,
    checked_alarm_rate,
    compared,
    explain_all,
    focus,
    observe,
)
from beliefscope.inspect.diagnosis.cause import SHOWN
from beliefscope.inspect.diagnosis.conclusion import conclude, healthy
from beliefscope.inspect.diagnosis.diagnose import diagnose, preliminary
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnostics.healthy_comparison import no_diagnosis
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile, pretrained_reference, profile_document
from beliefscope.inspect.healthy import profile_of, sensor_record
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all


@cache
def checkpoint() -> Checkpoint:
    return load_checkpoint(pretrained_path("push", "crossmodal-ekf"))


@cache
def simulated(first: int, count: int) -> dict[int, Episode]:
    simulate = load_task("push").simulate
    assert simulate is not None
    return {i: simulate(77, first + i, 60) for i in range(count)}


@cache
def profile() -> HealthyProfile:
    episodes = list(simulated(0, 20).values())
    images = pretrained_reference(load_task("push"))  # of the same camera
    return profile_of(checkpoint(), episodes, "seed 77", sensor_record(episodes, images))


@cache
def runs() -> list[Trace]:
    return list(trace_all(checkpoint(), simulated(0, 3), simulated(0, 3)))


def faulty(faults: str) -> Mapping[int, Episode]:
    return {index: Faults.parse(faults).apply(episode) for index, episode in simulated(100, 6).items()}


@pytest.mark.slow
def test_clean_episodes_are_healthy() -> None:
    result = diagnose(checkpoint(), simulated(100, 6), profile=profile())
    assert (result.state, result.masked, result.causes) == ("healthy", False, ())
    assert "Healthy" in result.headline


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("nees", "start"),
    [
        (4.0, "Healthy, though overconfident (median NEES/n 4): no significant deviation from the record of 44"),
        (0.2, "Healthy, though underconfident (median NEES/n 0.2): no"),
        (1e9, "Always overconfident (median NEES/n 1e+09), even in its healthy record; no significant deviation from"),
        (1.3, "Healthy: no significant deviation from the record of 44 healthy episodes in 1 statistics."),
    ],
)
def test_a_healthy_diagnosis_says_if_its_record_is_miscalibrated(nees: float, start: str) -> None:
    """A filter whose covariance has always been too small does not deviate from its own record."""
    name = "nees/fused/all"
    record = HealthyProfile("test", 44, None, {name: np.append(nees * np.linspace(0.9, 1.1, 43), 500.0)})
    case = compared(
        RunInputs(checkpoint(), {}, 300, frozenset()), runs()[:2], [{name: nees}] * 2, [{}] * 2, record, 0.05
    )
    result = healthy(case)
    assert result.headline.startswith(start)
    assert [deviation.value for deviation in result.deviations] == [nees]
    assert result.to_json()["miscalibrated"] == ("confident" in start)
    small = "; a larger record shows smaller faults"
    assert small not in result.headline
    assert small in healthy(replace(case, traces=case.traces[:1], rows=case.rows[:1])).headline


def test_readings_that_most_steps_repeat_are_a_fault_in_a_single_episode() -> None:
    """One of six episodes among 26 is the most unusual one with a probability of 6 / 26, whatever its size."""
    name, inputs = "frozen/image/all", RunInputs(checkpoint(), {}, 300, frozenset())

    def alarms(share: float, healthy_share: float = 0.0) -> list[str]:
        nees = np.linspace(0.8, 1.2, 20)
        record = HealthyProfile(
            "test", 20, None, {name: np.append(np.zeros(19), healthy_share), "nees/fused/all": nees}
        )
        rows = [{name: 0.0, "nees/fused/all": 1.0}] * 5 + [{name: share, "nees/fused/all": 1.0}]
        return [alarm.statistic for alarm in compared(inputs, runs()[:1] * 6, rows, rows, record, 0.02).alarms]

    assert alarms(0.9) == [name]
    assert alarms(0.4) == alarms(0.9, healthy_share=0.3) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "cause", "steps"),
    [
        ("image_frozen:from=30", "image.frozen", " from step 31 (3.1 s)"),
        pytest.param("image_frozen", "image.frozen", " at all steps", marks=pytest.mark.long),
        pytest.param(
            "blackout:from=20:to=40", "image.blackout", " from step 20 to 39 (2.0 to 3.9 s)", marks=pytest.mark.long
        ),
        pytest.param("force_stuck", "force.stuck", " at all steps", marks=pytest.mark.long),
        pytest.param("force_bias=3", "force.bias", "", marks=pytest.mark.long),
        pytest.param("force_bias=8:from=30", "force.bias", " from step 30 (3.0 s)", marks=pytest.mark.long),
        pytest.param("force_drift=2", "force.drift", "", marks=pytest.mark.long),
    ],
)
def test_a_planted_sensor_fault_is_named_with_its_steps(faults: str, cause: str, steps: str) -> None:
    progress: list[float] = []
    result = diagnose(checkpoint(), faulty(faults), profile=profile(), progress=progress.append)
    first = result.causes[0]
    assert (result.state, first.cause.name) == ("fault", cause)
    assert first.evidence[0].value > first.evidence[0].high
    assert first.evidence[0].sensor == first.cause.component
    assert result.headline.startswith(f"{first.cause.title}{steps}, probability ")
    assert progress == sorted(progress)
    assert progress[-1] == pytest.approx(1.0)
    if faults == "image_frozen:from=30":
        assert first.steps == (31, 60)


@pytest.mark.slow
def test_a_healthy_diagnosis_states_what_was_compared() -> None:
    """Statistics by sensor, of controls, labels, models and filter; and those that these episodes cannot have."""
    result = diagnose(checkpoint(), simulated(100, 6), profile=profile())
    numbers = result.to_json()["statistics"]
    assert {*checkpoint().task.observations, "control", "labels", "models", "filter"} == set(numbers)
    assert f"in {sum(numbers.values())} statistics" in result.headline
    touching = {i: with_contact(episode) for i, episode in simulated(100, 6).items()}
    compared_ = diagnose(checkpoint(), touching, profile=profile())
    assert compared_.to_json()["statistics"]["force"] < numbers["force"]


def with_contact(episode: Episode) -> Episode:
    """The episode with the contact flag at every step, hence without free motion."""
    flag = np.ones_like(episode.observations["contact"])
    return replace(episode, observations={**episode.observations, "contact": flag})


def test_sensors_without_statistics_are_named() -> None:
    sensors = {name: np.ones(20) for name in ("level/force x/free motion", "noise/force x/all")}
    record = HealthyProfile("test", 20, None, {name: values + 0.1 * np.arange(20) for name, values in sensors.items()})
    rows = [{"noise/force x/all": 1.5 + 0.1 * i} for i in range(3)]
    inputs = RunInputs(checkpoint(), {}, 300, frozenset())
    sensed = [{**row, "level/force x/free motion": np.nan} for row in rows]
    result = healthy(compared(inputs, runs(), rows, sensed, record, 0.05))
    *sensors_, statistic = result.to_json()["unmeasured"]
    assert sensors_ == [name.replace("_", " ") for name in checkpoint().task.observations if name != "force"]
    assert statistic == "level of force (x) in free motion"
    assert result.unmeasured[-1] == statistic
    assert result.tables()[-1].rows[-1] == (statistic,)
    assert not result.to_json()["outdated"]
    for name in ("opposed/control x/all", "noise/torque x/expected"):
        newer = [{**row, name: 1.0} for row in rows]
        document = healthy(compared(inputs, runs(), newer, sensed, record, 0.05)).to_json()
        assert document["outdated"]
        text = "statistics that the healthy record of an earlier version lacks (1): measure it again"
        assert document["unmeasured"][-1] == text


def test_episodes_of_another_length_than_those_of_the_record_are_mentioned() -> None:
    record = HealthyProfile("test", 20, None, {"noise/force x/all": 1.0 + 0.1 * np.arange(20)})
    rows, inputs = [{"noise/force x/all": 2.0}] * 3, RunInputs(checkpoint(), {}, 300, frozenset())
    length = len(runs()[0])
    for steps, text in (
        (None, None),
        ((length, length), None),
        ((length, 9 * length), None),
        ((5 * length, 5 * length), f"{length} steps, those of the healthy record {5 * length} steps"),
        (
            (length // 4, length // 3),
            f"{length} steps, those of the healthy record {length // 4} to {length // 3} steps",
        ),
    ):
        result = healthy(compared(inputs, runs(), rows, rows, replace(record, steps=steps), 0.05))
        first = result.to_json()["unmeasured"][0]
        assert first == (f"statistics that depend on the length: episodes have {text}" if text else "image"), steps


def test_reading_models_of_an_earlier_version_are_measured_again() -> None:
    """Their record has statistics of readings that the episodes cannot have."""
    of_readings = {"reading bias/gps x/all": 0.1 * np.arange(20)}
    record = HealthyProfile("test", 20, None, {"noise/force x/all": 1.0 + 0.1 * np.arange(20), **of_readings})
    rows, inputs = [{"noise/force x/all": 2.0}] * 3, RunInputs(checkpoint(), {}, 300, frozenset())
    assert healthy(compared(inputs, runs(), rows, rows, record, 0.05)).to_json()["outdated"]


def test_faults_after_all_steps_are_refused() -> None:
    """By everything that injects faults before a diagnosis."""
    with pytest.raises(BadInput, match=r"blackout:from=100 starts after the last step, 99"):
        bs.diagnose("push/crossmodal-ekf", "push", [0, 1], faults="blackout:from=100")


@pytest.mark.slow
def test_focused_episodes_are_compared_with_each_other() -> None:
    """Statistics that depend on the other episodes are those of the chosen ones, not of all from before."""
    episodes = dict(simulated(100, 6)) | {i: faulty("effector_offset=0.05")[i] for i in (1, 4)}
    runs = list(trace_all(checkpoint(), episodes, episodes, 0, 300))
    rows, sensors = zip(*(observe(run, checkpoint(), profile()) for run in runs), strict=True)
    inputs = RunInputs(checkpoint(), episodes, 300, frozenset(episodes))
    case = compared(inputs, runs, rows, sensors, profile(), 0.05)
    part = focus(case)
    chosen = [run.episode_index for run in part.traces]
    assert chosen == [1, 4]
    alone = compared(part.inputs, part.traces, [rows[i] for i in chosen], part.sensors, profile(), 0.05)
    assert part.grouped == alone.grouped
    assert part.grouped != [case.grouped[i] for i in chosen]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "action"), [(1, "held-out"), (3, "`beliefscope slices push --filter crossmodal-ekf`")]
)
def test_a_fault_without_a_probable_cause_has_deviations_and_a_next_action(count: int, action: str) -> None:
    episodes = {i: faulty("image_frozen:from=10")[i] for i in range(count)}
    traces = list(trace_all(checkpoint(), episodes, episodes, 0, 300))
    rows, sensors = zip(*(observe(trace, checkpoint(), profile()) for trace in traces), strict=True)
    inputs = RunInputs(checkpoint(), episodes, 300, frozenset(episodes), healthy=profile())
    case = compared(inputs, traces, rows, sensors, profile(), 0.05)
    unlikely = {name: replace(explanation, support=-3.0) for name, explanation in explain_all(case).items()}
    result = conclude(case, case, unlikely, {})
    assert (result.state, result.listed) == ("unsure", ())
    assert max(cause["probability"] for cause in result.to_json()["causes"]) < SHOWN
    assert result.headline.startswith(f"No cause stands out: {case.alarms[0].text}; try: ")
    assert action in result.headline
    assert result.tables()[0].title == "Largest deviations"
    assert result.tables()[0].rows[0][0] == result.deviations[0].text == case.alarms[0].text


def test_episodes_are_affected_unless_they_are_healthy() -> None:
    """A weak fault of all episodes is not taken for one of those that happen to show it most."""
    weak = deviations_in(lambda healthy, spread: [healthy + 1.5 * spread] * 3 + [healthy + 0.6 * spread] * 3)
    some = deviations_in(lambda healthy, spread: [healthy + 9.0 * spread] * 3 + [healthy] * 3)
    every = deviations_in(lambda healthy, spread: [healthy + 9.0 * spread] * 3 + [healthy + 4.0 * spread] * 3)
    assert affected_episodes(weak, weak.deviations).tolist() == [True] * 6
    assert affected_episodes(some, some.deviations).tolist() == [True] * 3 + [False] * 3
    assert affected_episodes(every, every.deviations).tolist() == [True] * 6


@pytest.mark.parametrize(("faulty", "alarm"), [(3, True), (1, False), (0, False)])
def test_most_episodes_far_outside_of_a_small_record_are_an_alarm(faulty: int, alarm: bool) -> None:
    """Of 12 healthy and 5 tested episodes, 1.5 % of the divisions hold three with the same fault."""
    rng = np.random.default_rng(0)
    names = [f"level/force {axis}/free motion" for axis in "xyz"] + [f"noise/force {axis}/all" for axis in "xyz"]
    record = {name: rng.normal(5.0, 0.5, 12) for name in names}
    rows = [{name: float(rng.normal(5.0, 0.5)) for name in names} for _ in range(5)]
    for row in rows[:faulty]:
        row[names[0]] = 100.0
    inputs = RunInputs(checkpoint(), {}, 300, frozenset())
    case = compared(inputs, [], rows, rows, HealthyProfile("test", 12, None, record), 0.02)
    assert [d.statistic for d in case.alarms[:1]] == ([names[0]] if alarm else [])


def deviations_in(values: Callable[[float, float], list[float]]) -> Case:
    """A case whose force along x has levels by episode, from those of healthy episodes and their standard deviation."""
    healthy = np.array([0.1 * (i % 11) for i in range(44)])
    name = "level/force x/free motion"
    rows = [{name: value} for value in values(float(healthy.mean()), float(healthy.std()))]
    inputs = RunInputs(checkpoint(), {}, 300, frozenset())
    return compared(inputs, [], rows, rows, HealthyProfile("test", 44, None, {name: healthy}), 0.05)


@pytest.mark.long
@pytest.mark.slow
def test_the_number_of_processes_does_not_matter() -> None:
    """Two blocks of episodes and up to three interventions, in one process and in two."""
    episodes = {i: Faults.parse("image_shift=3").apply(e) for i, e in simulated(0, 20).items()}
    serial, parallel = (diagnose(checkpoint(), episodes, profile=profile(), workers=workers) for workers in (1, 2))
    assert json.dumps(serial.to_json()) == json.dumps(parallel.to_json())
    assert serial.causes[0].recovered is not None


@pytest.mark.slow
def test_a_fault_in_some_episodes_is_examined_in_these() -> None:
    episodes = dict(simulated(100, 6)) | {i: faulty("image_frozen=5")[i] for i in (1, 4)}
    first = diagnose(checkpoint(), episodes, profile=profile()).causes[0]
    assert (first.cause.name, first.episodes) == ("image.frozen", (1, 4))
    assert first.evidence[0].value > 0.8  # share of repeated images in these episodes, not in all


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "masked"), [(0.7, True), (0.3, False)])
def test_a_fault_is_masked_if_undoing_it_changes_little(scale: float, masked: bool) -> None:
    """The NEES is inversely proportional to the scale of the reported covariance; its limit is 2."""
    filter_ = copy.deepcopy(checkpoint().filter)
    step = filter_.step

    def step_with_other_report(belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, Any]:
        belief, trace = step(belief, evidence, generator)
        estimate = replace(trace.estimate, covariance=scale * trace.estimate.covariance)
        return belief, replace(trace, estimate=estimate)

    object.__setattr__(filter_, "step", step_with_other_report)
    result = diagnose(replace(checkpoint(), filter=filter_), simulated(100, 6), profile=profile())
    assert (result.causes[0].cause.name, result.masked) == ("covariance.small", masked)


@pytest.mark.slow
def test_a_biased_module_is_named_and_its_error_recovered() -> None:
    filter_ = copy.deepcopy(checkpoint().filter)
    filter_.get_submodule("virtual_sensors.image.state").bias += 0.7
    planted = replace(checkpoint(), filter=filter_)
    result = diagnose(planted, simulated(100, 6), profile=profile())
    first = result.causes[0]
    assert (result.state, result.masked, first.cause.name) == ("fault", False, "model.image.bias")
    assert first.recovered is not None
    assert first.recovered.low > 0.3
    document = result.to_json()
    assert set(document["causes"][0]) == {
        *("cause", "title", "component", "probability", "episodes", "steps", "evidence", "recovered", "next")
    }
    listed = [cause["probability"] for cause in document["causes"]]
    assert listed == sorted(listed, reverse=True)
    assert 0.0 <= listed[-1] <= listed[0] <= 1.0
    assert result.tables()


def test_a_filter_needs_episodes_and_a_healthy_profile() -> None:
    with pytest.raises(BadInput, match="no episodes"):
        diagnose(checkpoint(), {})
    with pytest.raises(BadInput, match="no healthy record"):
        diagnose(replace(checkpoint(), hash="other", name="crossmodal-ekf"), simulated(100, 1))


@pytest.mark.long
@pytest.mark.slow
def test_the_alarm_rate_of_one_episode_depends_on_the_size_of_the_record() -> None:
    """One of n + 1 episodes is the most unusual one with probability 1 / (n + 1)."""
    assert [checked_alarm_rate(*sizes) for sizes in ((12, 1), (12, 2), (49, 1), (120, 1))] == [1 / 13, 0.02, 0.02, 0.02]
    small = replace(profile(), statistics={k: v[:12] for k, v in profile().statistics.items()}, episodes=12)
    black = faulty("blackout=0.9")
    one = diagnose(checkpoint(), {100: next(iter(black.values()))}, profile=small)
    assert (one.state != "healthy", one.provenance["alarm_rate"]) == (True, 1 / 13)
    assert diagnose(checkpoint(), black, profile=small).state != "healthy"
    with pytest.raises(BadInput, match=r"12 episodes cannot show a fault in a single one: .* of 0\.02 needs 49;"):
        checked_alarm_rate(12, 1, 0.02)


def test_a_record_of_too_few_episodes_is_no_diagnosis() -> None:
    """The comparison needs ten values of a statistic, so the page must not offer a diagnosis with fewer."""
    few, enough = (
        {**profile_document("push", "crossmodal-ekf", checkpoint().hash, None), "episodes": n} for n in (7, 20)
    )
    filter_ = replace(checkpoint(), hash="other", name="mine", healthy_profile=few)
    assert "a healthy record of 7 episodes, fewer than the 10 needed" in (no_diagnosis(filter_) or "")
    assert no_diagnosis(replace(filter_, healthy_profile=enough)) is None


@pytest.mark.long
@pytest.mark.slow
def test_external_filters_are_compared_with_a_measured_profile() -> None:
    external = open_filter("door", "examples/04_own_filter.py:build")
    with open_dataset(sample_path("door")) as data:
        healthy = [data[index] for index in range(150, 164)]
        frozen = {index: Faults.parse("image_frozen:from=20").apply(data[index]) for index in range(140, 143)}
    result = diagnose(external, frozen, profile=profile_of(external, healthy, "test"))
    assert result.state == "fault"
    assert "image.frozen" in [candidate.cause.name for candidate in result.causes]


def test_a_fault_of_an_unused_sensor_is_masked_before_it_is_undone() -> None:
    filter_ = load_checkpoint(pretrained_path("door", "haptics-ekf"))
    with open_dataset(sample_path("door")) as data:
        run = next(iter(trace_all(filter_, {9: Faults.parse("image_frozen:from=10").apply(data[9])}, [9])))
    result = preliminary(filter_, run)
    assert (result.state, result.masked, result.causes[0].cause.name) == ("fault", True, "image.frozen")
    assert result.headline.endswith("; the filter is unaffected")

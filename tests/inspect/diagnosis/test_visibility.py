"""When a fault counts as masked: by its effect on the same episodes, else against the healthy range."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnosis.cause import Recovery
from beliefscope.inspect.diagnosis.visibility import Effect, effect_ratios, is_visible
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.statistics.measures import counted
from beliefscope.inspect.traces.batch import trace_all


def error(value: float, alarm: bool = False) -> dict[str, Deviation]:
    """RMS position error of ``value`` in units of its healthy mean, whose healthy range is 0.7 to 1.4."""
    return {"error//all": Deviation("error//all", value, 1.0, 0.7, 1.4, 0.01, alarm, 1.0)}


def effect(ratio: float, complete: bool) -> Effect:
    """The error with the fault is ``ratio`` times that without it."""
    return Effect(Recovery(1.0 - 1.0 / ratio, 0.0, 0.0, 0.0, "position"), 0.0, {"error//all": ratio}, complete)


@pytest.mark.parametrize(
    ("value", "alarm", "undone", "visible"),
    [
        (1.1, False, None, False),  # within the healthy range
        (1.6, False, None, True),
        (1.0, False, effect(1.5, True), True),  # easy episodes: the error is larger than without the fault
        (1.6, False, effect(1.0, True), False),  # hard episodes: it is the same without the fault
        (3.0, True, effect(1.0, True), True),  # something else is wrong
        (1.0, False, effect(1.5, False), True),  # the filter is better without the sensor
        (1.6, False, effect(1.0, False), False),  # it does not use the sensor
        (1.6, False, effect(0.5, False), True),  # it needs the sensor, whose healthy readings are unknown
        (1.1, False, effect(0.5, False), False),
        (1.6, False, effect(0.5, True), True),  # the undo failed, whose errors are larger than with the fault
    ],
)
def test_visible(value: float, alarm: bool, undone: Effect | None, visible: bool) -> None:
    assert is_visible(error(value, alarm), undone) is visible


@pytest.mark.parametrize(
    ("undone", "known"),
    [(effect(1.0, True), True), (effect(0.5, True), False), (effect(1.0, False), True), (effect(0.9, False), False)],
)
def test_only_a_complete_undo_or_an_unused_sensor_shows_the_healthy_run(undone: Effect, known: bool) -> None:
    """Without a sensor that it needs, a filter is worse, whether the fault affects it or not."""
    assert undone.shows_healthy_run is known


def test_errors_of_velocities_and_biases_count_as_well() -> None:
    name = "component error/speed/all"
    assert is_visible({name: Deviation(name, 1.5, 1.0, 0.9, 1.1, 0.01, True, 9.0)}, None)
    assert is_visible({}, Effect(Recovery(0.0, 0.0, 0.0, 0.0, "position"), 0.0, {"error//all": 1.0, name: 1.5}, True))


@pytest.mark.parametrize(("nees", "visible"), [(3.0, True), (0.4, True), (1.5, False)])
def test_calibration_may_change_in_both_directions(nees: float, visible: bool) -> None:
    changed = Effect(Recovery(0.0, 0.0, 0.0, 0.0, "position"), 0.0, {"nees/fused/all": nees}, True)
    assert is_visible({}, changed) is visible


def test_calibration_after_a_failed_undo_says_nothing() -> None:
    ratios = {"error//all": 0.5, "nees/fused/all": 0.25}
    assert not is_visible({}, Effect(Recovery(-1.0, 0.0, 0.0, 0.0, "position"), 0.0, ratios, True))


def test_ratios_are_those_of_all_steps_of_all_episodes() -> None:
    """Errors by unit and the NEES, pooled: not means of episodes, which short or easy ones would dominate."""
    filter_ = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        episodes = {index: data[index] for index in data.held_out()[:3]}
    faulty = {index: Faults.parse("blackout=0.9").apply(episode) for index, episode in episodes.items()}
    before, after = (list(trace_all(filter_, group, group, 0, 30)) for group in (faulty, episodes))
    ratios = effect_ratios(before, after)
    squares = [
        np.concatenate([np.square(t.estimate_mean[counted(t)] - t.episode.states[counted(t)]) for t in group])
        for group in (before, after)
    ]
    position, angle = (
        [float(np.sqrt(group[:, part].sum(1).mean())) for group in squares] for part in (slice(0, 2), slice(2, 3))
    )
    assert ratios["error//all"] == pytest.approx(position[0] / position[1], rel=1e-5)
    assert ratios["angle error//all"] == pytest.approx(angle[0] / angle[1], rel=1e-5)
    assert set(ratios) == {"error//all", "angle error//all", "nees/fused/all"}

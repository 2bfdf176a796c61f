"""Undone faults: the replay without a planted fault is the run of the original filter."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.filter import Filter
from beliefscope.inspect.diagnosis.catalog import CAUSES
from beliefscope.inspect.diagnosis.checks.episode_statistics import episode_statistics
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.diagnosis.checks.vectors import free_motion
from beliefscope.inspect.diagnosis.diagnose import required_profile
from beliefscope.inspect.diagnosis.undo.confirmation import negative_log_likelihood, recovery
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnosis.undo.undo import BY_SUBJECT, UNDO, brings_back, undo
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all


@cache
def checkpoint(name: str) -> Checkpoint:
    return load_checkpoint(pretrained_path("door", name))


@cache
def episodes() -> dict[int, Episode]:
    with open_dataset(sample_path("door")) as data:
        return {index: data[index] for index in data.held_out()[:3]}


def inputs(filter_: Checkpoint, data: dict[int, Episode] | None = None) -> RunInputs:
    data = data or episodes()
    return RunInputs(filter_, data, 30, frozenset(data))


def traces(run: RunInputs) -> list[Trace]:
    return list(trace_all(run.checkpoint, run.episodes, run.episodes, 0, run.particles))


def deviations(healthy: RunInputs, faulty: RunInputs) -> dict[str, Deviation]:
    """Mean statistics of two runs."""
    rows = [
        [episode_statistics(trace, run.checkpoint, sensor_statistics(trace.episode, None)) for trace in traces(run)]
        for run in (healthy, faulty)
    ]
    result = {}
    for name in rows[0][0]:
        values = [[row[name] for row in group if np.isfinite(row.get(name, np.nan))] for group in rows]
        mean = [float(np.mean(group)) if group else np.nan for group in values]
        result[name] = Deviation(name, mean[1], mean[0], mean[0], mean[0], 0.0, True, 10.0)
    return result


def planted(name: str, change: Callable[[Any], None]) -> Checkpoint:
    filter_: Filter = copy.deepcopy(checkpoint(name).filter)
    change(filter_)
    return replace(checkpoint(name), filter=filter_)


def biased(filter_: Any) -> None:
    filter_.virtual_sensors.image.state.bias += 0.3


def overconfident(filter_: Any) -> None:
    filter_.virtual_sensors.image.log_noise[-1].bias -= math.log(1.5)


def noisy(filter_: Any) -> None:
    filter_.dynamics.log_noise += math.log(2.0)


def inverted(filter_: Any) -> None:
    output = filter_.weight_model.output
    output.weight *= -1.0
    output.bias *= -1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change", "action"),
    [
        ("crossmodal-ekf", biased, "shift image"),
        pytest.param("crossmodal-ekf", overconfident, "rescale image", marks=pytest.mark.long),
        pytest.param("crossmodal-ekf", noisy, "rescale process noise", marks=pytest.mark.long),
        pytest.param("crossmodal-pf", noisy, "rescale process noise", marks=pytest.mark.long),
        pytest.param("crossmodal-ekf", inverted, "invert beta", marks=pytest.mark.long),
        pytest.param("crossmodal-pf", inverted, "invert beta", marks=pytest.mark.long),
    ],
)
def test_the_replay_without_a_fault_of_the_model_is_the_original_run(
    name: str, change: Callable[[Any], None], action: str
) -> None:
    healthy, faulty = inputs(checkpoint(name)), inputs(planted(name, change))
    changed = undo(action, faulty, deviations(healthy, faulty))
    assert changed is not None
    distance = [
        [np.abs(a.estimate_mean - b.estimate_mean).mean() for a, b in zip(traces(healthy), traces(run), strict=True)]
        for run in (faulty, changed)
    ]
    assert np.sum(distance[1]) < 0.1 * np.sum(distance[0])


@pytest.mark.first(2)
@pytest.mark.parametrize("action", ["shift image", "rescale image", "restore image", "shift dynamics", "healthy beta"])
def test_a_base_checkpoint_replaces_modules(action: str) -> None:
    if action == "healthy beta":
        change: Callable[[Any], None] = inverted
    else:
        change = (lambda f: f.dynamics.output.bias.add_(1.0)) if "dynamics" in action else biased
    faulty = inputs(planted("crossmodal-ekf", change))
    changed = undo(action, faulty, {}, base=checkpoint("crossmodal-ekf"))
    assert changed is not None
    for a, b in zip(traces(inputs(checkpoint("crossmodal-ekf"))), traces(changed), strict=True):
        np.testing.assert_array_equal(a.estimate_mean, b.estimate_mean)


def values(**by_statistic: float) -> dict[str, Deviation]:
    """Deviations from zero of statistics; ``__`` stands for ``/`` and ``_`` for a space."""
    names = {name.replace("__", "/").replace("_", " "): value for name, value in by_statistic.items()}
    return {name: Deviation(name, value, 0.0, 0.0, 0.0, 0.0, True, 10.0) for name, value in names.items()}


GAIN = {"size/force/contact": Deviation("size/force/contact", 6.0, 3.0, 3.0, 3.0, 0.0, True, 10.0)}
BIAS = values(level__force_x__free_motion=1.0, level__force_y__free_motion=2.0, level__force_z__free_motion=0.0)
TORQUE_BIAS = values(
    level__torque_x__free_motion=1.0, level__torque_y__free_motion=2.0, level__torque_z__free_motion=0.0
)
DRIFT = values(drift__force_x__free_motion=1.0, drift__force_y__free_motion=0.0, drift__force_z__free_motion=0.0)


@pytest.mark.parametrize(
    ("faults", "action", "symptoms", "key"),
    [
        ("delay=image:steps=3", "advance image", values(lag__image__all=3.0), "image"),
        ("image_shift=2:y=-3", "realign image", values(shift__image_x__all=2.0, shift__image_y__all=-3.0), "image"),
        ("force_gain=2", "scale force", GAIN, "force"),
        ("force_gain=-1", "negate force", {}, "force"),
        ("force_bias=1:y=2", "tare force", BIAS, "force"),
        ("force_drift=1", "detrend force", DRIFT, "force"),
        ("torque_bias=1:y=2", "tare torque", TORQUE_BIAS, "torque"),
        ("force_axes=yzx", "permute force", {}, "force"),
    ],
)
def test_readings_without_a_fault_are_the_original_ones(
    faults: str, action: str, symptoms: dict[str, Deviation], key: str
) -> None:
    faulty = {index: Faults.parse(faults).apply(episode) for index, episode in episodes().items()}
    changed = undo(action, inputs(checkpoint("crossmodal-ekf"), faulty), symptoms)
    assert changed is not None
    for index, episode in episodes().items():
        inner = (slice(0, -3), slice(3, -3), slice(3, -3))[: episode.observations[key].ndim]
        np.testing.assert_allclose(
            changed.episodes[index].observations[key][inner], episode.observations[key][inner], atol=1e-4
        )


def test_a_bias_of_some_steps_is_removed_from_these() -> None:
    """Without knowledge of its steps, up to the noise of their level; contact hides where it begins and ends."""
    faulty = {index: Faults.parse("force_bias=8:from=60").apply(episode) for index, episode in episodes().items()}
    changed = undo("tare force", inputs(checkpoint("crossmodal-ekf"), faulty), BIAS)
    assert changed is not None
    free = [free_motion(episode) for episode in episodes().values()]
    true, wrong, restored = (
        np.concatenate([e[i].observations["force"][at, 0] for i, at in zip(e, free, strict=True)])
        for e in (episodes(), faulty, changed.episodes)
    )
    assert len(true) > 50
    assert np.abs(restored - true).mean() < 0.1 * np.abs(wrong - true).mean()


def test_controls_that_derive_from_readings_are_restored_with_them() -> None:
    """A delay of all haptic sensors also delays the controls, which are computed from them."""
    faulty = {index: Faults.parse("delay=haptics:steps=3").apply(episode) for index, episode in episodes().items()}
    changed = undo("advance haptics", inputs(checkpoint("crossmodal-ekf"), faulty), values(lag__image__all=-3.0))
    assert changed is not None
    for index, episode in episodes().items():
        assert not np.array_equal(faulty[index].controls, episode.controls)
        np.testing.assert_array_equal(changed.episodes[index].controls[1:-3], episode.controls[1:-3])


@pytest.mark.parametrize(
    "fault", ["contact_stuck=0:from=10", "contact_inverted=1", "contact_inverted=0.2", "contact_delayed=30"]
)
def test_the_contact_flag_is_restored_from_the_force(fault: str) -> None:
    """Whatever the flag was: it agrees with the true one at 95 % of the steps, also in the controls."""
    faulty = {index: Faults.parse(fault).apply(episode) for index, episode in episodes().items()}
    filter_ = checkpoint("crossmodal-ekf")
    changed = undo("restore contact", replace(inputs(filter_, faulty), healthy=required_profile(filter_)), {})
    assert changed is not None
    flags = [[e[i].observations["contact"] for i in episodes()] for e in (episodes(), faulty, changed.episodes)]
    true, wrong, restored = (np.concatenate(group) for group in flags)
    assert (wrong == true).mean() < 0.85
    assert (restored == true).mean() > 0.95
    for episode in changed.episodes.values():
        np.testing.assert_array_equal(episode.controls[:, 6:], episode.observations["contact"])


def test_an_offset_of_the_hand_is_measured_by_commanded_positions() -> None:
    """The controls of field tasks are commanded positions, which the fault does not change."""
    filter_ = load_checkpoint(pretrained_path("push-field", "information-ekf"))
    with open_dataset(sample_path("push-field")) as data:
        clean = data[data.held_out()[0]]
    faulty = Faults.parse("effector_offset=0.02:y=-0.01").apply(clean)
    symptoms = values(offset__control_x__all=-0.02, offset__control_y__all=0.01, offset__control_z__all=0.0)
    changed = undo("shift hand", inputs(filter_, {0: faulty}), symptoms)
    assert changed is not None
    distance = changed.episodes[0].observations["effector_position"] - clean.observations["effector_position"]
    assert np.abs(distance).max() < 1e-6


def test_an_offset_of_the_hand_is_measured_in_the_image() -> None:
    """Other controls derive from the measured positions and have the same offset."""
    profile = required_profile(checkpoint("crossmodal-ekf"))
    reference = profile.reference
    assert reference is not None
    assert reference.hand is not None
    faulty = {i: Faults.parse("effector_offset=0.02:y=-0.01").apply(e) for i, e in episodes().items()}
    centre = reference.hand.scale[:1]
    pixels = (reference.hand.pixels(centre) - reference.hand.pixels(centre + np.array([[0.02, -0.01, 0.0]])))[0]
    symptoms = values(hand_offset__image_x__all=pixels[0], hand_offset__image_y__all=pixels[1])
    run = replace(inputs(checkpoint("crossmodal-ekf"), faulty), healthy=profile)
    changed = undo("shift hand", run, symptoms)
    assert changed is not None
    for index, episode in episodes().items():
        distance = changed.episodes[index].observations["effector_position"] - episode.observations["effector_position"]
        assert np.abs(distance).max() < 2e-3
        assert np.abs(changed.episodes[index].controls - episode.controls).max() < 2e-3


def test_labels_are_restored() -> None:
    delayed = {i: replace(e, states=e.states[np.maximum(np.arange(len(e)) - 3, 0)]) for i, e in episodes().items()}
    offset = {i: replace(e, states=e.states + np.float32([0.02, 0.0, 0.0])) for i, e in episodes().items()}
    healthy = inputs(checkpoint("crossmodal-ekf"))
    advanced = undo("advance labels", inputs(checkpoint("crossmodal-ekf"), delayed), values(lag__labels__all=3.0))
    run = inputs(checkpoint("crossmodal-ekf"), offset)
    shifted = undo("shift labels", run, deviations(healthy, run))
    assert advanced is not None
    assert shifted is not None
    for index, episode in episodes().items():
        np.testing.assert_array_equal(advanced.episodes[index].states[:-3], episode.states[:-3])
        np.testing.assert_allclose(shifted.episodes[index].states, episode.states, atol=1e-4)


def test_only_affected_episodes_change() -> None:
    run = replace(inputs(checkpoint("crossmodal-ekf")), affected=frozenset(list(episodes())[:1]))
    changed = undo("negate force", run, {})
    assert changed is not None
    same = [changed.episodes[index] is episode for index, episode in episodes().items()]
    assert same == [False, True, True]


@pytest.mark.parametrize(("own", "expected"), [(20, 300), (300, None), (1000, None)])
def test_few_particles_become_as_many_as_in_the_record(own: int, expected: int | None) -> None:
    run = replace(inputs(checkpoint("unimodal-pf")), particles=own)
    deviation = Deviation("particles//all", float(own), 300.0, 300.0, 300.0, 0.0, True, -10.0)
    changed = undo("healthy particles", run, {deviation.statistic: deviation})
    assert (None if changed is None else changed.particles) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [("restore equations", True), ("shift image", True), ("drop image", False), ("restore haptics", False)],
)
def test_only_some_interventions_bring_back_what_was_healthy(name: str, expected: bool) -> None:
    assert brings_back(name) is expected
    assert brings_back("restore haptics", checkpoint("crossmodal-ekf"))


def test_the_last_modality_is_not_dropped() -> None:
    assert undo("drop image", inputs(checkpoint("image-ekf")), {}) is None
    assert undo("drop image", inputs(checkpoint("feature-ekf")), {}) is None
    assert undo("drop image", inputs(checkpoint("unimodal-ekf")), {}) is not None


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", ["crossmodal-ekf", "unimodal-pf", "image-ekf"])
def test_lost_images_are_skipped_step_by_step(name: str) -> None:
    """The pixels of a lost image do not matter, and images of other steps are used."""
    black, gray = (
        {index: Faults.parse(f"blackout=0.4:gray={value}").apply(e) for index, e in episodes().items()}
        for value in (0, 128)
    )
    runs = [undo("skip lost images", inputs(checkpoint(name), data), {}) for data in (black, gray)]
    assert None not in runs
    first, second = (traces(run) for run in runs if run is not None)
    for index, (a, b) in enumerate(zip(first, second, strict=True)):
        np.testing.assert_array_equal(a.estimate_mean, b.estimate_mean)
        clean = traces(inputs(checkpoint(name)))[index]
        lost = np.flatnonzero((black[a.episode_index].observations["image"] == 0).all((1, 2)))
        np.testing.assert_array_equal(a.estimate_mean[: lost[0]], clean.estimate_mean[: lost[0]])
        assert not np.array_equal(a.estimate_mean[lost[0]], clean.estimate_mean[lost[0]])


def test_recovery_compares_runs() -> None:
    healthy, faulty = (traces(inputs(c)) for c in (checkpoint("crossmodal-ekf"), planted("crossmodal-ekf", biased)))
    same, better = recovery(faulty, faulty), recovery(faulty, healthy)
    assert (same.error, same.nll) == (0.0, 0.0)
    assert better.error > 0.3
    assert better.nll > 0.0


def test_recovery_is_of_the_error_that_falls_most() -> None:
    after = traces(inputs(checkpoint("crossmodal-ekf")))

    def moved(trace: Trace, component: int) -> Trace:
        """An estimate that is 0.1 m or rad more wrong."""
        truth, mean = trace.episode.states, trace.estimate_mean.copy()
        mean[:, component] += 0.1 * np.where(mean[:, component] > truth[:, component], 1, -1)
        return replace(trace, estimate_mean=mean)

    for component, measure in enumerate(("position", "position", "angle")):
        result = recovery([moved(trace, component) for trace in after], after)
        assert result.measure == measure
        assert result.error > 0.5


def test_without_ground_truth_the_innovations_are_compared() -> None:
    (trace, *_) = traces(inputs(checkpoint("crossmodal-ekf")))
    unknown = replace(trace, episode=replace(trace.episode, states=np.full_like(trace.episode.states, np.nan)))
    assert math.isfinite(negative_log_likelihood(unknown))
    assert negative_log_likelihood(unknown) != negative_log_likelihood(trace)
    result = recovery([unknown], [unknown])
    assert math.isnan(result.error)
    assert result.nll == 0.0


@pytest.mark.parametrize("cause", CAUSES, ids=lambda cause: cause.name)
def test_the_undo_of_every_cause_exists(cause: Any) -> None:
    for name in filter(None, cause.undo.split("|")):
        action, _, subject = name.rpartition(" ")
        assert name in UNDO or (action in BY_SUBJECT and subject)

"""Causes in cameras, sensors and measurement models of a user's task, which the catalog does not name."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from tests.inspect.diagnosis.test_catalog import deviation

from beliefscope.datasets.covariate import CONTACT, Covariate
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.diagnosis.catalog import causes_of
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.diagnosis.conclusion import channels_text
from beliefscope.inspect.diagnosis.scoring import applicable, explain, probabilities
from beliefscope.inspect.diagnosis.undo.readings import scale_control
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnosis.undo.undo import undo
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation, compare, with_critical_values
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.healthy import SensorRecord, sensor_record

SENSORS = {"image": (8, 8), "gps": (2,)}
TASK = Task("cart", (Component("x", "m"), Component("y", "m")), SENSORS, {k: (k,) for k in SENSORS}, 0, 0.1)


def bias(modality: str, value: float) -> Deviation:
    """Bias of a measurement model in x, m, whose healthy range is 1 cm wide."""
    return Deviation(f"module bias/{modality} x/all", value, 0.0, -0.005, 0.005, 0.0, abs(value) > 0.01, 50.0 * value)


def seen_beside_label(key: str) -> Deviation:
    return Deviation(f"object offset/{key} x/all", 3.0, 0.0, -0.1, 0.1, 0.0, True, 5.0)


def ranked(task: Task, *deviations: Deviation) -> dict[str, float]:
    causes = applicable(causes_of(task), [deviation.statistic for deviation in deviations])
    return probabilities({cause.name: explain(cause, deviations) for cause in causes})


def test_a_second_sensor_separates_a_moved_camera_from_labels_with_an_offset() -> None:
    camera = ranked(TASK, seen_beside_label("image"), bias("image", 0.1), bias("gps", 0.0))
    labels = ranked(TASK, seen_beside_label("image"), bias("image", 0.1), bias("gps", 0.1))
    assert camera["image.shift"] > 0.8 > 0.25 > camera["labels.offset"]
    assert labels["labels.offset"] > 0.8 > 0.25 > labels["image.shift"]


def test_colour_images_have_the_statistics_of_their_luminance() -> None:
    rng, steps = np.random.default_rng(0), 30
    task = replace(TASK, observations={"image": (8, 8, 3), "gps": (2,)})

    def episodes(*axes: int) -> list[Episode]:
        result = []
        for _ in range(3):
            gray = rng.integers(0, 255, (steps, 8, 8)).astype(np.uint8)
            image = np.repeat(gray[..., None], 3, -1) if axes else gray
            states, gps = rng.normal(size=(steps, 2)), rng.normal(size=(steps, 2))
            result.append(Episode(task if axes else TASK, states, observations={"image": image, "gps": gps}))
        return result

    gray = sensor_record(episodes())
    rng = np.random.default_rng(0)
    colour = sensor_record(episodes(3))
    for row, same in zip(colour.rows, gray.rows, strict=True):
        assert dict(row) == pytest.approx(dict(same), nan_ok=True)
    assert "brightness/image/all" in colour.rows[0]


@pytest.mark.parametrize(("noise", "explained"), [(8.0, True), (-8.0, False)])
def test_a_bias_of_a_part_of_an_episode_adds_to_the_noise(noise: float, explained: bool) -> None:
    """Around the mean error, which does not become smaller."""
    values = [deviation("reading bias/gps x/all", 8.0), deviation("reading noise/gps x/all", noise)]
    (cause,) = (cause for cause in causes_of(TASK) if cause.name == "gps.bias")
    assert (explain(cause, values).unexplained == {}) == explained


@pytest.mark.parametrize("masks", [{}, {"gps": "fix"}])
def test_a_delay_of_a_sensor_with_gaps_adds_to_its_noise(masks: dict[str, str]) -> None:
    task = replace(TASK, masks=masks, covariates=dict.fromkeys(masks.values(), CONTACT))
    values = [deviation("reading lag/gps/all", 16.0), deviation("noise/gps x/extreme", 5.0)]
    (cause,) = (cause for cause in causes_of(task) if cause.name == "gps.delay")
    assert (explain(cause, values).unexplained == {}) == bool(masks)


def test_with_the_camera_alone_both_remain_probable() -> None:
    result = ranked(TASK, seen_beside_label("image"), bias("image", 0.1))
    assert min(result["image.shift"], result["labels.offset"]) > 0.2


def test_cameras_have_the_name_of_their_sensor_and_a_hand_replaces_labels() -> None:
    renamed = replace(TASK, observations={"front": (8, 8)}, modalities={"camera": ("front",)})
    causes = {cause.name: cause for cause in causes_of(renamed)}
    assert (causes["front.shift"].title, causes["front.shift"].undo) == ("Camera front moved", "drop camera")
    result = ranked(renamed, seen_beside_label("front"), bias("camera", 0.1))
    assert result["front.shift"] > 0.2
    with_hand = replace(TASK, observations=SENSORS | {"effector_position": (3,)})
    (moved,) = (cause for cause in causes_of(with_hand) if cause.name == "image.shift")
    assert "hand offset/image*" in moved.symptoms[0].statistics


@pytest.mark.parametrize("modality", ["image", "gps"])
def test_a_modality_behind_the_labels_is_delayed(modality: str) -> None:
    """Labels behind all modalities have the opposite sign."""
    late = Deviation(f"lag/labels {modality}/all", -4.0, 0.0, -0.5, 0.5, 0.0, True, -5.0)
    assert ranked(TASK, late)[f"{modality}.delay"] > 0.9
    assert ranked(TASK, replace(late, value=4.0, t=5.0)).get(f"{modality}.delay", 0.0) < 0.1


@pytest.mark.parametrize("mechanism", ["bias", "overconfident", "underconfident", "broken"])
def test_models_of_own_modalities_have_causes(mechanism: str) -> None:
    names = [cause.name for cause in causes_of(TASK)]
    assert names.count(f"model.gps.{mechanism}") == names.count(f"model.image.{mechanism}") == 1


def test_a_biased_model_of_an_own_modality_is_not_data_that_differ_as_a_whole() -> None:
    error = Deviation("module error/gps x/all", 0.1, 0.02, 0.018, 0.022, 0.0, True, 5.0)
    power = Deviation("module power/gps/all", 1.0, 1.0, 0.9, 1.1, 1.0, False, 0.0)
    result = ranked(TASK, bias("gps", 0.1), bias("image", 0.0), error, power)
    assert result["model.gps.bias"] > 0.8
    assert max(result["data.shift"], result["labels.offset"]) < 0.1


WRENCH = Task(
    name="peg",
    components=(Component("x", "m"), Component("y", "m"), Component("yaw", "rad")),
    observations={"camera": (8, 8), "wrench": (2,)},
    modalities={"camera": ("camera",), "haptics": ("wrench",)},
    control_size=2,
    dt=0.05,
    map_half_width=0.01,
    covariates={"contact": CONTACT},
)


def slide(seed: int) -> Episode:
    """A peg slides by 5 mm, as commanded; the wrench depends on the state in contact and is small otherwise."""
    rng = np.random.default_rng(seed)
    controls = np.repeat(rng.normal(0.0, 5e-4, (15, 2)), 4, axis=0)
    states = np.cumsum(np.hstack([-controls, np.zeros((60, 1))]) + rng.normal(0.0, [5e-5, 5e-5, 2e-3], (60, 3)), axis=0)
    contact = np.arange(60) >= 20
    wrench = np.where(contact[:, None], [2.0, 0.02] * (1.0 + 300.0 * states[:, :2]), 0.0)
    wrench = wrench + rng.normal(0.0, 1.0, (60, 2)) * [0.05, 5e-4]
    images = rng.integers(0, 255, (60, 8, 8)).astype(np.uint8)
    return Episode(WRENCH, states, controls, {"camera": images, "wrench": wrench}, contact=contact)


@cache
def record() -> SensorRecord:
    return sensor_record([slide(seed) for seed in range(30)])


def test_progress_covers_the_whole_measurement() -> None:
    shares: list[float] = []
    sensor_record([slide(seed) for seed in range(5)], progress=shares.append)
    assert shares == sorted(shares)
    assert shares[0] < 0.2
    assert shares[-1] == 1.0


def still(*, observations: object, controls: np.ndarray) -> np.ndarray:
    return np.zeros((*controls.shape[:-1], 3))


STILL = as_external(still, "still", WRENCH)


@pytest.mark.first(5)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "cause"),
    [
        ("sensor_gain=wrench:factor=10", "wrench.gain"),
        ("sensor_gain=wrench:factor=0.5", "wrench.gain"),
        ("sensor_noise=wrench:std=1", "wrench.noise"),
        ("sensor_bias=wrench:offset=0.02", "wrench.bias"),
        ("sensor_drift=wrench:rate=0.02", "wrench.drift"),
        ("sensor_gain=wrench:factor=-1", "wrench.sign"),
        ("sensor_swapped=wrench", "wrench.axes"),
        ("delay=haptics:steps=3", "wrench.delay"),
        ("control_scale=-1", "control.sign"),
        ("control_scale=0.1", "control.scale"),
        ("control_delay=4", "control.delay"),
    ],
)
def test_faults_of_readings_and_controls_of_a_task_without_a_measured_hand(faults: str, cause: str) -> None:
    """A bias of 0.02 is small for the force of 2 N and large for the torque of 0.02 N m in the same sensor."""
    rows = record().rows
    values = {name: np.array([row.get(name, np.nan) for row in rows]) for name in rows[0]}
    profile = HealthyProfile("peg", len(rows), None, values, record().reference, record().readings)
    tested = [
        sensor_statistics(Faults.parse(faults).apply(slide(seed), seed), record().reference, record().readings)
        for seed in range(30, 42)
    ]
    deviations = with_critical_values(profile, compare(profile, tested, task=WRENCH), 0.02)
    causes = applicable(causes_of(WRENCH), [d.statistic for d in deviations])
    result = probabilities({c.name: explain(c, deviations) for c in causes})
    assert max(result, key=lambda name: result[name]) == cause
    assert result[cause] > 0.8


def test_wrong_channels_are_put_back() -> None:
    """The undo restores the readings up to their noise: order and signs, of the affected episodes only."""
    profile = HealthyProfile("peg", len(record().rows), None, {}, record().reference, record().readings)
    episode = slide(50)
    wrong = Faults.parse("sensor_swapped=wrench, sensor_gain=wrench:factor=-1").apply(episode, 0)
    inputs = RunInputs(STILL, {0: wrong, 1: wrong}, 1, frozenset({0}), healthy=profile)
    result = undo("rearrange wrench", inputs, {})
    assert result is not None
    np.testing.assert_array_equal(result.episodes[0].observations["wrench"], episode.observations["wrench"])
    assert result.episodes[1] is wrong
    assert undo("rearrange wrench", replace(inputs, episodes={0: episode}), {}) is None, "nothing to put back"
    assert undo("rearrange wrench", replace(inputs, healthy=None), {}) is None


@pytest.mark.parametrize(
    ("name", "fault", "tolerance"),
    [
        ("tare wrench", "sensor_bias=wrench:offset=3", 0.2),
        ("detrend wrench", "sensor_drift=wrench:rate=3", 0.2),
        ("scale wrench", "sensor_gain=wrench:factor=3", 0.2),
    ],
)
def test_biases_drifts_and_gains_are_undone_by_the_expected_readings(name: str, fault: str, tolerance: float) -> None:
    """Up to the mean error of an episode, in standard deviations of the readings; other episodes stay as they are."""
    profile = HealthyProfile("peg", len(record().rows), None, {}, record().reference, record().readings)
    episode = slide(50)
    wrong = Faults.parse(fault).apply(episode, 0)
    inputs = RunInputs(STILL, {0: wrong, 1: wrong}, 1, frozenset({0}), healthy=profile)
    result = undo(name, inputs, {})
    assert result is not None
    readings, true = result.episodes[0].observations["wrench"], episode.observations["wrench"]
    assert (np.abs(readings - true).max(0) < tolerance * true.std(0)).all()
    assert (np.abs(wrong.observations["wrench"] - true).max(0) > 2.0 * tolerance * true.std(0)).any()
    assert result.episodes[1] is wrong
    assert undo(name, replace(inputs, healthy=None), {}) is None


def test_scaled_controls_are_divided_by_their_factor() -> None:
    wrong = Faults.parse("control_scale=-2").apply(slide(0), 0)
    inputs = RunInputs(STILL, {0: wrong}, 1, frozenset({0}))
    gains = [
        Deviation(f"reading gain/control {axis}/all", -2.0, 1.0, 0.99, 1.01, 0.0, True, -9.0) for axis in ("x", "y")
    ]
    result = scale_control(inputs, {gain.statistic: gain for gain in gains})
    assert result is not None
    np.testing.assert_allclose(result.episodes[0].controls, slide(0).controls, rtol=1e-6)


def test_a_camera_behind_the_labels_has_a_cause_beside_labelled_contact() -> None:
    """The contact shows the delay of the wrench better."""
    names = {cause.name for cause in causes_of(WRENCH)}
    assert {"camera.delay", "wrench.delay"} <= names
    assert "haptics.delay" in names, "of the catalog"


def test_models_of_sensors_with_own_names_may_have_faulty_sensors() -> None:
    titles = {cause.name: cause.title for cause in causes_of(WRENCH)}
    assert titles["model.haptics.broken"] == "Sensors or model of haptics broken"
    assert {"weights.ignores_camera", "weights.ignores_haptics"} <= titles.keys()
    forces = replace(WRENCH, observations={"force": (3,)}, modalities={"haptics": ("force",)})
    (sign,) = (cause for cause in causes_of(forces) if cause.name == "model.haptics.underconfident")
    assert sign.title == "Sensors or model of haptics underconfident", (
        "without a hand, no law shows the sign of a force"
    )
    assert sign.next.startswith("Check the calibration of its sensors")
    assert [cause.title for cause in causes_of(DOOR) if cause.name == "model.haptics.broken"] == [
        "Haptics model broken"
    ]


def test_single_modality_updates_behind_the_labels_are_a_consequence_of_wrong_controls() -> None:
    gain = Deviation("inverted/control x/all", 2.0, 0.0, 0.0, 0.1, 0.0, True, 20.0)
    late = Deviation("lag/labels camera/all", -9.0, 0.0, -0.5, 0.5, 0.0, True, -10.0)
    result = ranked(WRENCH, gain, late)
    assert result["control.sign"] > 0.7 > 0.3 > result["camera.delay"]


def test_inverted_dynamics_are_not_frozen() -> None:
    def slope(value: float) -> list[Deviation]:
        numbers = (value, 1.0, 0.9, 1.1, 0.0, True, 20.0 * (value - 1.0))
        return [Deviation(f"dynamics slope/{name}/all", *numbers) for name in "xy"]

    inverted, frozen = ranked(WRENCH, *slope(-1.0)), ranked(WRENCH, *slope(0.1))
    assert inverted["dynamics.inverted"] > 0.7
    gain = Deviation("inverted/control x/all", 2.0, 0.0, 0.0, 0.1, 0.0, True, 20.0)
    wrong = ranked(WRENCH, *slope(-1.0), gain)
    assert wrong["control.sign"] > 0.7 > 0.3 > wrong["dynamics.inverted"], "the controls themselves are inverted"
    assert frozen["dynamics.frozen"] > 0.7 > 0.1 > frozen["dynamics.inverted"]


@pytest.mark.parametrize(
    ("t_values", "expected"),
    [({"x": 9.0}, " (east)"), ({"x": -9.0, "y": 3.0}, " (east)"), ({"x": 9.0, "y": 5.0}, ""), ({}, "")],
)
def test_headlines_name_the_channels_of_a_cause(t_values: dict[str, float], expected: str) -> None:
    """Those that deviate by more than half as much as the most deviating one, unless these are all of them."""
    task = replace(TASK, channels={"gps": (Component("east", "m"), Component("north", "m"))})
    alarms = [Deviation(f"reading bias/gps {c}/all", 1.0, 0.0, -0.1, 0.1, 0.0, True, t) for c, t in t_values.items()]
    alarms.append(Deviation("error//all", 1.0, 0.0, -0.1, 0.1, 0.0, True, 50.0))
    (cause,) = (cause for cause in causes_of(task) if cause.name == "gps.bias")
    case = SimpleNamespace(alarms=alarms, inputs=SimpleNamespace(checkpoint=SimpleNamespace(task=task)))
    assert channels_text(case, cause) == expected
    unnamed = SimpleNamespace(alarms=alarms, inputs=SimpleNamespace(checkpoint=SimpleNamespace(task=TASK)))
    assert channels_text(unnamed, cause) == ""


def test_lost_readings_of_a_sensor_with_a_mask_have_a_cause() -> None:
    task = replace(TASK, masks={"gps": "gps reading"}, covariates={"gps reading": Covariate("boolean")})
    steps, received = 60, np.arange(60) % 3 == 0
    observations = {"image": np.zeros((steps, 8, 8), np.uint8), "gps": np.zeros((steps, 2))}
    episode = Episode(task, np.zeros((steps, 2)), observations=observations, covariates={"gps reading": received})
    assert sensor_statistics(episode, None)["absent/gps/all"] == pytest.approx(2 / 3)
    lost = deviation("absent/gps/all", 5.0)
    assert ranked(task, lost)["gps.dropout"] > 0.9
    assert not any(cause.name == "gps.dropout" for cause in causes_of(TASK))


def test_a_saturated_channel_is_not_stuck() -> None:
    episode = slide(0)
    force = episode.observations["wrench"].copy()
    waves = 2.0 + np.sin(np.arange(60)) + 0.01 * np.random.default_rng(0).normal(size=60)
    force[:, 0] = np.minimum(waves, 2.5)  # reaches the limit in several stretches
    saturated = replace(episode, observations={**episode.observations, "wrench": force})
    force = force.copy()
    force[:, 0] = np.where(np.arange(60) < 20, waves, waves[20])
    stuck = replace(episode, observations={**episode.observations, "wrench": force})
    first, second = (sensor_statistics(e, None) for e in (saturated, stuck))
    assert (first["saturation/wrench x/all"], first["stuck/wrench x/all"]) == (pytest.approx(0.3, abs=0.1), 0.0)
    assert (second["saturation/wrench x/all"], second["stuck/wrench x/all"]) == (0.0, pytest.approx(39 / 60))

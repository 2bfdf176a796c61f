"""Models of sensors: exact on readings that are linear in their features, and none where labels say nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beliefscope.datasets.covariate import CONTACT, Covariate
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task, rotation
from beliefscope.inspect.diagnosis.checks.readings import (
    biased_interval,
    modelled_keys,
    modelled_sensors,
    reading_statistics,
)
from beliefscope.inspect.statistics.reading_features import features
from beliefscope.inspect.statistics.reading_fit import fit_reading_models
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.signals import wrapped

DT, STEPS, NOISE = 0.05, 120, 0.01
PLANE = Task(
    name="rover",
    components=(Component("x", "m"), Component("y", "m"), Component("yaw", "rad", wraps=True)),
    observations={"gps": (2,), "odometry": (2,), "battery": (1,)},
    modalities={"gps": ("gps",), "wheels": ("odometry", "battery")},
    control_size=0,
    dt=DT,
    covariates={"contact": CONTACT},
)


def smooth(rng: np.random.Generator, size: int) -> np.ndarray:
    """(T, size): sums of three sines with random phases and periods of 1 to 4 s."""
    t = DT * np.arange(STEPS)[:, None, None]
    return np.sin(2.0 * np.pi * (t / rng.uniform(1.0, 4.0, (size, 3)) + rng.random((size, 3)))).sum(-1)


def rove(seed: int) -> Episode:
    """Position and, in the body frame, the motion of each step; a battery voltage that nothing explains."""
    rng = np.random.default_rng(seed)
    position, yaw = 0.5 * smooth(rng, 2), 2.0 * smooth(rng, 1)[:, 0]
    motion = np.diff(position, axis=0, prepend=position[:1]) / DT
    forward = np.cos(yaw) * motion[:, 0] + np.sin(yaw) * motion[:, 1]
    left = -np.sin(yaw) * motion[:, 0] + np.cos(yaw) * motion[:, 1]
    observations = {
        "gps": position + np.array([3.0, -2.0]) + rng.normal(0.0, NOISE, (STEPS, 2)),
        "odometry": np.column_stack([forward, left]) + rng.normal(0.0, NOISE, (STEPS, 2)),
        "battery": 12.0 + rng.normal(0.0, 0.1, (STEPS, 1)),
    }
    states = np.column_stack([position, (yaw + np.pi) % (2.0 * np.pi) - np.pi])
    return Episode(PLANE, states, np.zeros((STEPS, 0)), observations, contact=np.zeros(STEPS))


def with_readings(episode: Episode, key: str, readings: np.ndarray) -> Episode:
    return replace(episode, observations={**episode.observations, key: readings.astype(np.float32)})


EPISODES = [rove(seed) for seed in range(12)]
NEW = rove(100)


@cache
def models() -> tuple[ReadingModel, ...]:
    """Of the GPS and the odometry."""
    return fit_reading_models(EPISODES, modelled_sensors(PLANE))


@pytest.fixture
def model(request: pytest.FixtureRequest) -> ReadingModel:
    return models()[request.param]


def test_only_sensors_that_the_labels_explain_have_a_model() -> None:
    assert [(model.key, model.channels) for model in models()] == [("gps", (0, 1)), ("odometry", (0, 1))]
    assert fit_reading_models(EPISODES[:3], ["gps"]) == (), "too few episodes"
    unlabelled = [replace(e, states=np.full_like(e.states, np.nan)) for e in EPISODES]
    assert fit_reading_models(unlabelled, ["gps"]) == ()
    assert len(fit_reading_models([*EPISODES, *unlabelled], ["gps"])) == 1


@pytest.mark.parametrize("model", [0, 1], ids=["gps", "odometry"], indirect=True)
def test_expected_readings_of_new_episodes_are_the_noise_free_ones(model: ReadingModel) -> None:
    compared = model.compare(NEW)
    error = (compared.readings - compared.expected)[compared.present]
    scale = np.mean([episode.observations[model.key].std(0) for episode in EPISODES], axis=0)
    assert error.std(0).max() < 1.2 * NOISE + 0.02 * scale.max()
    np.testing.assert_allclose(model.noise, np.maximum(NOISE, 0.01 * scale), rtol=0.3)


def test_readings_in_the_body_of_a_rotation_in_space_are_expected() -> None:
    """An accelerometer at rest measures gravity in the body frame, whose matrix is a feature."""
    sensors = {"observations": {"imu": (3,)}, "modalities": {"imu": ("imu",)}}
    task = replace(PLANE, components=rotation("turn"), map_components=(), **sensors)

    def turn(seed: int) -> Episode:
        rng = np.random.default_rng(seed)
        turned = Rotation.from_rotvec(0.7 * smooth(rng, 3))
        gravity = turned.inv().apply([0.0, 0.0, 9.81]) + rng.normal(0.0, 0.05, (STEPS, 3))
        return Episode(task, turned.as_rotvec(), np.zeros((STEPS, 0)), {"imu": gravity}, contact=np.zeros(STEPS))

    (model,) = fit_reading_models([turn(seed) for seed in range(8)], ["imu"])
    compared = model.compare(turn(50))
    assert (compared.readings - compared.expected)[compared.present].std(0).max() < 0.1
    assert model.channels == (0, 1, 2)


def test_linear_models_are_not_extrapolated() -> None:
    """Steps beyond the record do not count; those of a component that the readings do not depend on do."""
    gps, far = models()[0], np.arange(STEPS) >= 90
    within = replace(NEW, states=NEW.states * np.float32([0.5, 0.5, 1.0]))
    away = replace(within, states=within.states + np.where(far, 5.0, 0.0)[:, None].astype(np.float32) * [1, 0, 0])
    np.testing.assert_array_equal(gps.compare(away).present, ~far & (np.arange(STEPS) >= 2))
    assert gps.unknown_steps(away) == (30, STEPS - 2)
    turned = replace(within, states=within.states + np.float32([0.0, 0.0, 4.0 * np.pi]))
    assert gps.unknown_steps(turned) == gps.unknown_steps(within) == (0, STEPS - 2)
    earlier = {**gps.to_json(), "of_channels": [{**m.to_json(), "limits": [[], []]} for m in gps.of_channels]}
    assert ReadingModel.from_json(earlier).unknown_steps(away) == (0, STEPS - 2), "records of earlier versions"


@pytest.mark.parametrize("delay", [0, 3])
def test_delays_do_not_depend_on_steps_beyond_the_record(delay: int) -> None:
    """The readings there are those of another law."""
    gps = models()[0]
    far = (np.arange(STEPS) % 40) > 25
    late = NEW.observations["gps"][np.maximum(np.arange(STEPS) - delay, 0)] + 3.0 * far[:, None]
    away = with_readings(NEW, "gps", late)
    away = replace(away, states=NEW.states + np.where(far, 5.0, 0.0)[:, None] * np.float32([1.0, 1.0, 0.0]))
    values = reading_statistics(away, [gps])
    assert values["reading lag/gps/all"] == pytest.approx(delay, abs=0.1)
    assert np.isfinite([value for name, value in values.items()]).all()


def test_errors_are_those_of_the_noise_where_channels_match() -> None:
    """A signed permutation of the channels has them at the places of this permutation."""
    clean = models()[0].compare(NEW).errors()
    readings = NEW.observations["gps"][:, ::-1] * [1.0, -1.0]
    turned = models()[0].compare(with_readings(NEW, "gps", readings)).errors()
    assert np.diagonal(clean[0]).max() < 2.0 < 100.0 < min(clean[0, 0, 1], clean[1, 0, 0])
    np.testing.assert_allclose([turned[0, 0, 1], turned[1, 1, 0]], [clean[0, 1, 1], clean[0, 0, 0]], rtol=1e-3)


@pytest.mark.parametrize("delay", [0, 1, 4, 9])
@pytest.mark.parametrize("model", [0, 1], ids=["gps", "odometry"], indirect=True)
def test_delays_are_exact(model: ReadingModel, delay: int) -> None:
    late = NEW.observations[model.key][np.maximum(np.arange(STEPS) - delay, 0)]
    values = reading_statistics(with_readings(NEW, model.key, late), models())
    assert values[f"reading lag/{model.key}/all"] == pytest.approx(delay, abs=0.02 if delay == 0 else 0.0)
    assert values[f"inverted/{model.key} x/all"] == 0.0, "errors, gain and noise are those at the delay"
    assert values[f"reading gain/{model.key} x/all"] == pytest.approx(1.0, abs=0.005)
    assert round(values[f"reading noise/{model.key} x/all"]) == 1


def test_wrong_channels_show_in_their_own_statistics_only() -> None:
    gps = NEW.observations["gps"]

    def of(readings: np.ndarray) -> dict[str, float]:
        return reading_statistics(with_readings(NEW, "gps", readings), models())

    clean, inverted, exchanged = of(gps), of(gps * [1.0, -1.0]), of(gps[:, ::-1])
    assert max(v for name, v in clean.items() if name.startswith(("inverted", "exchanged"))) == 0.0
    assert inverted["inverted/gps y/all"] > 3.0, "log-ratio of the motion and the noise"
    assert inverted["inverted/gps x/all"] == inverted["exchanged/gps x/all"] == 0.0
    assert min(exchanged["exchanged/gps x/all"], exchanged["exchanged/gps y/all"]) > 1.0
    biased = of(gps + models()[0].noise)
    assert biased["reading bias/gps x/all"] - clean["reading bias/gps x/all"] == pytest.approx(1.0, abs=1e-4)


def test_a_drift_is_neither_a_gain_nor_noise_nor_a_bias_of_an_interval() -> None:
    """It grows over the episode; a gain and an interval leave little of the slope over time that they cause."""
    gps, noise = NEW.observations["gps"], models()[0].noise
    times = np.arange(STEPS)[:, None] / STEPS

    def of(readings: np.ndarray) -> dict[str, float]:
        values = reading_statistics(with_readings(NEW, "gps", readings), models())
        return {kind: values[f"reading {kind}/gps x/all"] for kind in ("bias", "drift", "gain", "noise")}

    clean, drifting = of(gps), of(gps + 40.0 * noise * times)
    assert drifting["drift"] - clean["drift"] == pytest.approx(40.0, abs=2.0)
    assert drifting["bias"] - clean["bias"] == pytest.approx(20.0, abs=0.5), "its mean"
    assert (drifting["gain"], drifting["noise"]) == pytest.approx((clean["gain"], clean["noise"]), abs=0.1)
    assert abs(of(1.2 * gps)["drift"]) < 1.0 < 0.15 / noise[0], "the gain adds 0.15 m and more"
    interval = (times > 0.5) & (times < 0.7)
    assert abs(of(gps + 40.0 * noise * interval)["drift"]) < 2.0


def test_absent_readings_do_not_count() -> None:
    task = replace(PLANE, masks={"gps": "fix"}, covariates={"contact": CONTACT, "fix": CONTACT})
    fix = (np.arange(STEPS) % 3 == 0).astype(np.float32)
    readings = np.where(fix[:, None] > 0.0, NEW.observations["gps"], 0.0)
    episode = replace(with_readings(NEW, "gps", readings), task=task, covariates={"fix": fix})
    assert np.diagonal(models()[0].compare(episode).errors()[0]).max() < 2.0


def test_models_are_stored_as_json() -> None:
    stored = ReadingModel.from_json(json.loads(json.dumps(models()[0].to_json())))
    np.testing.assert_allclose(stored.compare(NEW).expected, models()[0].compare(NEW).expected, rtol=0.0, atol=2e-3)
    channel = models()[0].to_json()["of_channels"][0]
    with pytest.raises(ValueError, match=r"constants \(2,\)"):
        ReadingModel.from_json({**models()[0].to_json(), "of_channels": [{**channel, "constants": [1.0, 2.0]}]})


def test_a_model_of_other_features_has_no_steps() -> None:
    (other,) = fit_reading_models([replace(e, task=replace(PLANE, covariates={})) for e in EPISODES], ["gps"])
    assert not other.compare(NEW).present.any()
    assert np.isnan(reading_statistics(NEW, [other])["reading bias/gps x/all"])


IMU = replace(
    PLANE,
    name="imu",
    observations={"compass": (1,)},
    modalities={"compass": ("compass",)},
    control_size=3,
)


def fly(seed: int) -> Episode:
    """A heading that wraps around, and controls that are acceleration and turn rate in the body frame."""
    rng = np.random.default_rng(seed)
    position, yaw = 0.5 * smooth(rng, 2), 3.0 * smooth(rng, 1)[:, 0] + rng.uniform(-np.pi, np.pi)
    velocity = np.diff(position, axis=0, prepend=position[:1]) / DT
    x, y = np.diff(velocity, axis=0, prepend=velocity[:1]).T / DT
    rate = np.diff(yaw, prepend=yaw[:1]) / DT
    controls = np.column_stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, rate])
    heading = yaw + 1.0 + rng.normal(0.0, 0.05, STEPS)
    yaw, heading = ((angle + np.pi) % (2.0 * np.pi) - np.pi for angle in (yaw, heading))
    states = np.column_stack([position, yaw])
    noisy = controls + rng.normal(0.0, 0.2, controls.shape)
    return Episode(IMU, states, noisy, {"compass": heading[:, None]}, contact=np.zeros(STEPS))


@cache
def of_flights() -> tuple[ReadingModel, ...]:
    """Of the compass and the controls."""
    return fit_reading_models([fly(seed) for seed in range(12)], modelled_keys(IMU))


def test_angles_are_compared_modulo_a_turn() -> None:
    compass, flight = of_flights()[0], fly(100)
    assert (compass.key, compass.is_angle.tolist()) == ("compass", [True])
    assert np.abs(np.diff(flight.observations["compass"][:, 0])).max() > np.pi, "it wraps around"
    turned = (flight.observations["compass"] + 0.4 + np.pi) % (2.0 * np.pi) - np.pi
    before, after = (
        reading_statistics(with_readings(flight, "compass", readings), of_flights())["reading bias/compass/all"]
        for readings in (flight.observations["compass"], turned)
    )
    assert (after - before) * compass.noise[0] == pytest.approx(0.4, abs=1e-4)


PORT = replace(
    PLANE,
    name="port",
    observations={"beacon": (2,), "range": (2,)},
    modalities={"beacon": ("beacon",), "range": ("range",)},
)
BEACONS = np.array([[8.0, 6.0], [-9.0, 2.0]])


def cruise(seed: int) -> Episode:
    """Bearings of two beacons, which wrap around with the opposite of the heading, and their distances."""
    rng = np.random.default_rng(seed)
    position, yaw = 1.5 * smooth(rng, 2), 3.0 * smooth(rng, 1)[:, 0]
    x, y = (BEACONS - position[:, None]).transpose(2, 0, 1)
    bearing = np.arctan2(y, x) - yaw[:, None] + rng.normal(0.0, 2.0 * NOISE, (STEPS, 2))
    distance = np.hypot(x, y) + rng.normal(0.0, 2.0 * NOISE, (STEPS, 2))
    states = np.column_stack([position, wrapped(yaw)])
    observations = {"beacon": wrapped(bearing), "range": distance}
    return Episode(PORT, states, np.zeros((STEPS, 0)), observations, contact=np.zeros(STEPS))


def test_bearings_and_distances_of_unknown_beacons_are_expected() -> None:
    """Landmarks are where they are, and leave hardly more than the noise; bearings turn against the heading."""
    beacon, distance = fit_reading_models([cruise(seed) for seed in range(20)], ["beacon", "range"])
    for i, place in enumerate(BEACONS):
        np.testing.assert_allclose(beacon.of_channels[i].landmark, place, atol=0.3)
        np.testing.assert_allclose(distance.of_channels[i].landmark, place, atol=0.3)
        np.testing.assert_array_equal(beacon.of_channels[i].heading, [0.0, 0.0, -1.0])
    assert (beacon.is_angle.tolist(), distance.is_angle.tolist()) == ([True, True], [False, False])
    episode = cruise(100)
    for model in (beacon, distance):
        compared = model.compare(episode)
        assert (compared.readings - compared.expected)[compared.present].std(0).max() < 1.2 * 2.0 * NOISE
    bearings = episode.observations["beacon"]
    clean, inverted, biased, longer = (
        reading_statistics(with_readings(episode, key, readings), [beacon, distance])
        for key, readings in (
            ("beacon", bearings),
            ("beacon", -bearings),
            ("beacon", wrapped(bearings + 0.1)),
            ("range", 1.1 * episode.observations["range"]),
        )
    )
    assert clean["inverted/beacon x/all"] == 0.0 < 1.0 < inverted["inverted/beacon x/all"]
    shift = biased["reading bias/beacon x/all"] - clean["reading bias/beacon x/all"]
    assert shift * beacon.noise[0] == pytest.approx(0.1, abs=1e-4)
    assert longer["reading gain/range x/all"] == pytest.approx(1.1, abs=0.02)


def test_controls_in_the_body_frame_are_sensors() -> None:
    controls, flight = of_flights()[1], fly(100)
    assert (controls.key, controls.channels) == ("control", (0, 1, 2))
    clean = reading_statistics(flight, of_flights())
    exchanged = reading_statistics(replace(flight, controls=flight.controls[:, [1, 0, 2]]), of_flights())
    inverted = reading_statistics(replace(flight, controls=flight.controls * [1, 1, -1]), of_flights())
    degrees = reading_statistics(replace(flight, controls=flight.controls * [1, 1, 180 / np.pi]), of_flights())
    assert clean["exchanged/control x/all"] == clean["inverted/control z/all"] == 0.0
    assert min(exchanged["exchanged/control x/all"], inverted["inverted/control z/all"]) > 0.5
    assert degrees["reading gain/control z/all"] == pytest.approx(180 / np.pi, rel=0.05)
    assert "control" not in modelled_keys(replace(IMU, control_size=0))


def test_periodic_readings_with_the_opposite_sign_are_not_delayed() -> None:
    t = DT * np.arange(STEPS)
    states = np.column_stack([np.sin(2.0 * np.pi * t), np.cos(2.0 * np.pi * t), np.zeros(STEPS)])
    episode = replace(NEW, states=states)
    for sign, name in ((1.0, "clean"), (-1.0, "inverted")):
        values = reading_statistics(
            with_readings(episode, "gps", sign * (np.array([3.0, -2.0]) + states[:, :2])), models()
        )
        assert abs(values["reading lag/gps/all"]) < 0.1, name
        assert (values["inverted/gps x/all"] > 1.0) == (sign < 0.0)


def test_biases_of_two_channels_are_no_exchange() -> None:
    """A rover that stands still reads about constants, which two biases can bring near to each other's."""
    states = np.column_stack([0.01 * NEW.states[:, :2], NEW.states[:, 2]])
    gps = NEW.observations["gps"] - NEW.states[:, :2] + states[:, :2]
    standing = replace(NEW, states=states.astype(np.float32))
    biases = np.array([3.0, -3.0]) * NOISE
    exchanged, biased = (
        reading_statistics(with_readings(standing, "gps", gps[:, ::-1] + b), models()) for b in (0.0, biases)
    )
    assert exchanged["exchanged/gps x/all"] > 3.0
    assert biased["exchanged/gps x/all"] == 0.0


def test_repeated_readings_have_no_delay_of_their_own() -> None:
    """A clock that drifts repeats some readings late; a sensor that is stuck repeats one that was in time."""
    steps, gps = np.arange(STEPS), NEW.observations["gps"]
    drifting = gps[np.maximum(steps - np.linspace(0.0, 9.0, STEPS).astype(int), 0)]
    stuck = gps[np.minimum(steps, STEPS // 2)]
    late, in_time = (reading_statistics(with_readings(NEW, "gps", x), models()) for x in (drifting, stuck))
    assert late["reading lag/gps/all"] > 2.0
    far = gps[np.maximum(steps - np.linspace(0.0, 18.0, STEPS).astype(int), 0)]
    assert reading_statistics(with_readings(NEW, "gps", far), models())["reading lag/gps/all"] == 8.0
    assert in_time["reading lag/gps/all"] == pytest.approx(0.0, abs=0.05)


def test_a_bias_from_some_step_on_is_no_delay_of_a_motion_in_its_direction() -> None:
    rng = np.random.default_rng(4)
    x = np.cumsum(0.35 * DT * (1.0 + 0.2 * np.sin(np.arange(STEPS) / 9.0))) - 1.0
    moving = replace(NEW, states=np.column_stack([x, 0.2 * x, np.zeros(STEPS)]).astype(np.float32))
    gps = moving.states[:, :2] + np.array([3.0, -2.0]) + rng.normal(0.0, NOISE, (STEPS, 2))
    bias = np.where(np.arange(STEPS) < 80, 0.0, 6.0 * NOISE)[:, None] * [1.0, 0.0]
    biased, late = (with_readings(moving, "gps", readings) for readings in (gps + bias, np.roll(gps, 2, axis=0)))
    assert reading_statistics(biased, models())["reading lag/gps/all"] == pytest.approx(0.0, abs=0.1)
    assert reading_statistics(late, models())["reading lag/gps/all"] == pytest.approx(2.0, abs=0.2)
    assert biased_interval("gps x", biased, models()) == (80, STEPS - 1)
    assert biased_interval("gps x", with_readings(moving, "gps", gps + 6.0 * NOISE), models()) is None
    assert biased_interval("battery x", biased, models()) is None


def test_a_heading_among_the_controls_turns_readings_into_the_body_frame() -> None:
    heading = Component("yaw", "rad", wraps=True)
    task = replace(PLANE, components=PLANE.components[:2], control_size=1, channels={"control": (heading,)})
    episodes = [replace(e, task=task, states=e.states[:, :2], controls=e.states[:, 2:]) for e in EPISODES]
    assert [(m.key, m.channels) for m in fit_reading_models(episodes, ["odometry"])] == [("odometry", (0, 1))]
    unknown = replace(task, channels={})
    assert fit_reading_models([replace(e, task=unknown) for e in episodes], ["odometry"]) == ()


def test_readings_that_do_not_follow_have_no_larger_noise() -> None:
    """A gain is divided out of the noise, but not one of nearly zero."""
    (model, _), rng = models(), np.random.default_rng(5)
    for gain in (0.02, -0.02):
        readings = gain * NEW.observations["gps"] + rng.normal(0.0, NOISE, (STEPS, 2))
        values = reading_statistics(with_readings(NEW, "gps", readings), [model])
        assert values["reading noise/gps x/all"] == pytest.approx(1.0, abs=0.2)


def test_any_boolean_covariate_has_readings_of_its_own() -> None:
    """A firm grip as contact does: the features are equal, and the masks of absent readings have none."""
    task = replace(PLANE, covariates={"firm": Covariate("boolean")})
    masked = replace(task, masks={"gps": "firm"})
    flag = (np.arange(STEPS) % 40 < 20).astype(np.float32)
    touched = features(replace(NEW, contact=flag > 0.5), False)[0]
    firm, present = (features(replace(NEW, task=t, covariates={"firm": flag}), False)[0] for t in (task, masked))
    assert np.array_equal(firm, touched)
    assert np.array_equal(firm[:, : present.shape[1]], present)
    assert firm.shape[1] == 2 * present.shape[1] + 1

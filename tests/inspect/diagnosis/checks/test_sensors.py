"""Laws of sensor statistics on simulated episodes: a fault changes its own statistic by the planted amount."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.simulation.push import CAMERA, IMPEDANCE, PUSH, RADIUS, PuckPhysics, PushPuck, push_model
from beliefscope.datasets.simulation.simulate import ROBOT_JOINTS, Scene, first_free_start, simulate
from beliefscope.datasets.store import open_dataset
from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.diagnosis.checks.controls import impedance_statistics
from beliefscope.inspect.diagnosis.checks.sensors import biased_steps, localise, sensor_statistics
from beliefscope.inspect.diagnosis.checks.vectors import free_motion
from beliefscope.inspect.diagnosis.checks.windows import LENGTH, STRIDE, deviating_windows
from beliefscope.inspect.statistics.reference_images import Reference, measure_reference

TASKS = ("door", pytest.param("push", marks=pytest.mark.long))


@lru_cache
def episodes(task: str) -> tuple[Episode, ...]:
    """Ten clean episodes of the sample set: the last six for the reference."""
    with open_dataset(f"datasets/samples/{task}.h5") as data:
        return tuple(data[i] for i in range(140, 150))


@lru_cache
def reference(task: str) -> Reference:
    result = measure_reference(episodes(task)[4:])
    assert result is not None
    return result


@lru_cache
def medians(task: str, faults: str = "") -> Mapping[str, float]:
    """Statistic -> median over four episodes that are not in the reference; NaN where it is never defined."""
    rows = [sensor_statistics(Faults.parse(faults).apply(e), reference(task)) for e in episodes(task)[:4]]
    values = {
        name: [row[name] for row in rows if np.isfinite(row.get(name, np.nan))] for name in {**rows[0], **rows[1]}
    }
    return {name: float(np.median(column)) if column else np.nan for name, column in values.items()}


def change(task: str, faults: str, statistic: str) -> float:
    return medians(task, faults)[statistic] - medians(task)[statistic]


@pytest.mark.first(4)
@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    ("faults", "statistic", "amount", "tolerance"),
    [
        pytest.param("image_frozen:from=60", "frozen/image/all", 0.39, 0.01, marks=pytest.mark.long),
        ("blackout:from=60", "black/image/all", 0.4, 1e-6),
        ("blackout:from=60", "losses/image/all", 0.01, 1e-6),
        pytest.param("blackout=0.3", "losses/image/all", 0.3 * 0.7, 0.06, marks=pytest.mark.long),
        pytest.param("image_underexposed=0.5", "brightness/image/all", -0.5, 0.01, marks=pytest.mark.long),
        pytest.param("image_noise=20", "noise/image/all", 20.0, 1.0, marks=pytest.mark.long),
        pytest.param("delay=image:steps=4", "lag/image/all", 4.0, 0.2, marks=pytest.mark.long),
        ("delay=haptics:steps=4", "lag/image/all", -4.0, 0.2),
        ("image_occluded=10:gray=255", "occlusion/image/all", 0.09, 0.03),
        ("image_shift=2", "hand offset/image x/all", 2.0, 0.2),
        ("force_bias=5", "level/force x/free motion", 5.0, 0.01),
        ("force_drift:y=0.5", "drift/force y/free motion", 0.5, 1e-3),
        pytest.param("torque_bias=0.2", "level/torque x/free motion", 0.2, 1e-3, marks=pytest.mark.long),
        pytest.param("force_noise=4", "noise/force z/all", 4.0, 0.7, marks=pytest.mark.long),
        ("force_stuck=x:from=20", "stuck/force x/all", 0.65, 0.25),
        ("contact_delayed=3", "lag/contact/all", 3.0, 0.3),
        pytest.param("contact_inverted=0.3", "toggles/contact/all", 2 * 0.3 * 0.7, 0.06, marks=pytest.mark.long),
        ("effector_noise=0.004", "position noise/effector_position/all", 0.004, 4e-4),
        pytest.param("drop=haptics:from=50", "stuck/effector_position/all", 0.5, 0.01, marks=pytest.mark.long),
    ],
)
def test_the_statistic_changes_by_the_planted_amount(
    task: str, faults: str, statistic: str, amount: float, tolerance: float
) -> None:
    assert change(task, faults, statistic) == pytest.approx(amount, abs=tolerance)


@pytest.mark.parametrize("task", TASKS)
def test_an_inverted_contact_flag_opposes_the_force(task: str) -> None:
    """From the first step: then no step tells what the flag was before."""
    assert change(task, "contact_inverted=1", "agreement/contact/all") < -1.2
    assert change(task, "contact_inverted=1", "opposition/contact/all") > 0.3


@pytest.mark.parametrize("task", TASKS)
def test_a_flag_that_changes_once_shows_no_opposition(task: str) -> None:
    """Stuck from a step in contact and inverted from there, the readings of an episode of contact are the same."""
    for clean in episodes(task):
        flag = clean.observations["contact"][:, 0] > 0.5
        if (touched := np.flatnonzero(flag)).size < 20:
            continue
        stuck = Faults.parse(f"contact_stuck=0:from={touched[10]}").apply(clean)
        values = sensor_statistics(stuck, None)
        once = np.abs(np.diff(stuck.observations["contact"][:, 0])).sum() == 1
        assert np.isnan(values["opposition/contact/all"]) == once


@pytest.mark.parametrize("task", TASKS)
def test_a_gain_keeps_the_roughness_of_the_force_and_noise_raises_it(task: str) -> None:
    name = "roughness/force/contact"
    assert change(task, "force_gain=3", name) == pytest.approx(0.0, abs=1e-6)  # stored as float32
    assert change(task, "force_noise=8", name) > 0.1


@pytest.mark.long
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    ("faults", "statistic", "amount", "tolerance"),
    [
        ("image_noise=30", "noise/image/extreme", 30.0, 3.0),
        ("image_underexposed=0.4", "brightness/image/range", 1.5, 0.15),
        ("force_noise=4", "noise/force z/extreme", 4.0, 1.5),
        ("effector_noise=0.004", "position noise/effector_position/extreme", 0.004, 1e-3),
    ],
)
def test_a_fault_of_a_fifth_of_the_steps_shows_in_the_windows_only(
    task: str, faults: str, statistic: str, amount: float, tolerance: float
) -> None:
    faults = f"{faults}:from=40:to=60"
    assert change(task, faults, statistic) == pytest.approx(amount, abs=tolerance)
    kind, subject, _ = statistic.split("/")
    assert abs(change(task, faults, f"{kind}/{subject}/all")) < 0.2 * amount


@pytest.mark.parametrize("task", TASKS)
def test_a_bias_begins_in_free_motion(task: str) -> None:
    """A bias of all steps has no first one; another begins at its first step, or at the first free one after it."""
    for clean in (episode for episode in episodes(task) if free_motion(episode).sum() > 30):
        free = np.flatnonzero(free_motion(clean))
        assert biased_steps(Faults.parse("force_bias=8").apply(clean), "force", 0) is None
        first = int(free[len(free) // 2])
        steps = biased_steps(Faults.parse(f"force_bias=8:from={first}").apply(clean), "force", 0)
        assert steps == (first, len(clean) - 1)


def test_windows_that_deviate_are_adjacent() -> None:
    values = np.array([1.0, 1.0, 3.0, 4.0, 1.0, np.nan, 4.5, 1.0])
    assert deviating_windows(values) == (6 * STRIDE, 6 * STRIDE + LENGTH - 1)
    assert deviating_windows(values[:5]) == (2 * STRIDE + STRIDE // 2, 3 * STRIDE + LENGTH - 1 - STRIDE // 2)
    late = np.array([1.0, 1.0, 5.0, 5.0, 5.0, 5.0])  # the first ones would deviate from the median
    assert deviating_windows(late, healthy=1.0) == (2 * STRIDE + STRIDE // 2, 5 * STRIDE + LENGTH - 1)
    assert deviating_windows(np.ones(4)) is None


@pytest.mark.first(3)
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    ("faults", "own"),
    [
        ("force_bias=5:y=-3", "level/force direction"),
        ("torque_bias=0.3", "level/torque"),
        (
            "force_drift=0.4",
            "drift/force level/force stuck noise roughness unflagged agreement lag/contact axes lever size direction",
        ),
        ("delay=image:steps=4", "lag/image shift offset hand sharpness occlusion"),
        ("image_underexposed=0.5", "brightness occlusion sharpness shift offset hand frozen lag/image"),
        (
            "contact_delayed=3",
            "lag/contact agreement unflagged share level drift change size roughness lever axes direction",
        ),
    ],
)
def test_other_statistics_do_not_change(task: str, faults: str, own: str) -> None:
    """All but the statistics of these names are invariant."""
    clean, faulty = medians(task), medians(task, faults)
    allowed = tuple(own.split())
    for name, value in clean.items():
        if not name.startswith(allowed):
            assert faulty[name] == pytest.approx(value, rel=1e-3, abs=2e-2, nan_ok=True), name


def with_force(task: str, scale: float, order: tuple[int, int, int]) -> Mapping[str, float]:
    rows = []
    for episode in episodes(task)[:4]:
        force = scale * episode.observations["force"][:, order]
        faulty = replace(episode, observations={**episode.observations, "force": force})
        rows.append(sensor_statistics(faulty, reference(task)))
    columns = {name: [row[name] for row in rows if np.isfinite(row.get(name, np.nan))] for name in rows[0]}
    return {name: float(np.mean(column)) for name, column in columns.items() if column}


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_laws_of_contact_separate_gain_sign_and_axes(task: str) -> None:
    identity = (0, 1, 2)
    healthy, half, inverted = (with_force(task, scale, identity) for scale in (1.0, 0.5, -1.0))
    for axis in "xyz":
        name = f"lever/force {axis}/contact"
        assert half[name] == pytest.approx(2.0 * healthy[name], rel=1e-4)
        assert inverted[name] == pytest.approx(-healthy[name], rel=1e-4)
    assert half["direction/force/contact"] == pytest.approx(healthy["direction/force/contact"], rel=1e-4)
    assert healthy["direction/force/contact"] < -0.3
    assert inverted["direction/force/contact"] > 0.3
    assert half["size/force/contact"] == pytest.approx(0.5 * healthy["size/force/contact"], rel=1e-4)
    exchanged = with_force(task, 1.0, (1, 0, 2))
    assert healthy["axes/force/contact"] > 0.5
    assert exchanged["axes/force/contact"] < -0.5
    assert exchanged["size/force/contact"] == pytest.approx(healthy["size/force/contact"], rel=1e-4)


@pytest.mark.parametrize("task", TASKS)
def test_delay_and_scale_of_controls(task: str) -> None:
    first = episodes(task)[0]
    controls = first.controls[np.maximum(np.arange(len(first)) - 3, 0)].copy()
    controls[:, 3:6] *= 0.5
    values = sensor_statistics(replace(first, controls=controls), None)
    assert values["lag/control/all"] == 3.0
    assert values["scale/control/all"] == pytest.approx(0.5, abs=0.01)
    healthy = sensor_statistics(first, None)
    assert (healthy["lag/control/all"], healthy["scale/control/all"]) == (0.0, pytest.approx(1.0))
    assert (values["step scale/control/all"], healthy["step scale/control/all"]) == pytest.approx((0.5, 1.0))
    assert max(abs(healthy[f"offset/control {axis}/all"]) for axis in "xyz") < 1e-6


@pytest.mark.parametrize("episode", range(3))
def test_the_law_of_the_impedance_controller(episode: int) -> None:
    """Offsets of the hand and biases, gains and signs of the force change its coefficients exactly, and nothing else.

    Tolerance: readings are float32.
    """
    with open_dataset("datasets/samples/push-field.h5") as data:
        clean = data[episode]

    def law(faults: str = "") -> dict[str, float]:
        return impedance_statistics(Faults.parse(faults).apply(clean) if faults else clean)

    healthy, moved, biased, scaled, negated, drifting = (
        law(f) for f in ("", "effector_offset=0.02", "force_bias=2", "force_gain=2", "force_gain=-1", "force_drift=2")
    )
    offset, compliance, following = "offset/control x/all", "compliance/force x/all", "following/control x/all"
    assert 2e-4 < healthy[compliance] < 2e-2  # m/N
    assert 0.5 < healthy[following] < 3.0  # steps
    assert abs(healthy[offset]) < 0.008
    assert moved[offset] == pytest.approx(healthy[offset] - 0.02, abs=1e-5)
    assert moved[compliance] == pytest.approx(healthy[compliance], rel=1e-3)
    assert biased[offset] == pytest.approx(healthy[offset] + 2.0 * healthy[compliance], abs=1e-5)
    assert scaled[compliance] == pytest.approx(healthy[compliance] / 2.0, rel=1e-3)
    assert negated[compliance] == pytest.approx(-healthy[compliance], rel=1e-3)
    for values in (moved, biased, scaled, negated):
        assert values[following] == pytest.approx(healthy[following], rel=1e-3)
    drift = "drift/force x/all"
    assert abs(healthy[drift]) < 0.1  # N/s
    assert drifting[drift] == pytest.approx(healthy[drift] + 2.0, abs=1e-3)
    for values, gain in ((moved, 1.0), (biased, 1.0), (scaled, 2.0), (negated, -1.0)):
        assert values[drift] == pytest.approx(gain * healthy[drift], abs=1e-4)


def test_a_set_point_that_is_the_measured_position_says_nothing_about_the_controller() -> None:
    values = impedance_statistics(episodes("door")[0])
    assert abs(values["offset/control x/all"]) < 1e-6
    assert np.isnan(values["compliance/force x/all"])
    assert np.isnan(values["following/control x/all"])


def test_image_shift_is_registered() -> None:
    def shifted(episode: Episode) -> Episode:
        image = np.roll(episode.observations["image"], (-2, 3), axis=(1, 2))
        return replace(episode, observations={**episode.observations, "image": image})

    rows = [sensor_statistics(shifted(e), reference("door")) for e in episodes("door")[:4]]
    x, y = (np.median([row[f"shift/image {axis}/all"] for row in rows]) for axis in "xy")
    assert x == pytest.approx(3.0, abs=0.7)
    assert y == pytest.approx(-2.0, abs=0.7)


@pytest.mark.first(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "statistic", "steps"),
    [
        ("image_frozen:from=40:to=70", "frozen/image/all", (41, 69)),
        ("blackout:from=12:to=30", "black/image/all", (12, 29)),
        pytest.param("force_noise=6:from=35", "noise/force y/all", (35, 99), marks=pytest.mark.long),
        pytest.param("image_noise=30:from=50:to=80", "noise/image/all", (50, 79), marks=pytest.mark.long),
        pytest.param("image_underexposed=0.4:from=64", "brightness/image/all", (64, 99), marks=pytest.mark.long),
        ("image_outage=0.4:seconds=1,image_underexposed=0.4:from=64", "brightness/image/all", (64, 99)),
        ("drop=haptics:from=25", "stuck/effector_position/all", (25, 99)),
        ("contact_inverted:from=40:to=60", "opposition/contact/extreme", (40, 59)),
    ],
)
def test_faults_are_localised(faults: str, statistic: str, steps: tuple[int, int]) -> None:
    faulty = Faults.parse(faults).apply(episodes("push")[0])
    interval = localise(statistic, faulty, reference("push"))
    assert interval is not None
    tolerance = STRIDE if statistic.endswith("extreme") else 2
    assert np.abs(np.subtract(interval, steps)).max() <= tolerance
    assert localise("lag/image/all", faulty, reference("push")) is None


@pytest.mark.long
def test_labels_with_an_offset_move_the_object_and_not_the_hand() -> None:
    """The puck is seen where it was, to a fifth of a pixel (3 mm along x): the distance is that of the labels."""
    with open_dataset("datasets/samples/push.h5") as data:
        reference_ = measure_reference([data[i] for i in range(100, 140)])
    assert reference_ is not None
    assert reference_.object is not None
    offset = np.array([0.02, -0.03], dtype=np.float32)
    moved = []
    for episode in episodes("push")[:4]:
        before, after = (
            sensor_statistics(e, reference_) for e in (episode, replace(episode, states=episode.states + offset))
        )
        assert all(after[f"hand offset/image {axis}/all"] == before[f"hand offset/image {axis}/all"] for axis in "xy")
        moved.append([after[name] - before[name] for name in (f"object offset/image {axis}/all" for axis in "xy")])
    middle = np.median(episodes("push")[0].states, axis=0)
    expected = np.subtract(*reference_.object.pixels(np.stack([middle, middle + offset]).astype(np.float64)))
    np.testing.assert_allclose(np.mean(moved, axis=0), expected, atol=0.2)


@pytest.mark.long
def test_the_hand_touches_a_larger_puck_farther_from_its_centre() -> None:
    """By the difference of the radii, in simulation; the fingers are the same."""
    with open_dataset("datasets/samples/push.h5") as data:
        reference_ = measure_reference([data[i] for i in range(100, 140)])
    larger = PuckPhysics(radius=RADIUS + 0.008)

    def simulated(index: int) -> Episode:
        def run(rng: np.random.Generator) -> Episode:
            scene = Scene(push_model(puck=larger), IMPEDANCE, CAMERA)
            positions = slice(ROBOT_JOINTS, ROBOT_JOINTS + 2)
            return simulate(PUSH, scene, PushPuck(rng, larger), lambda qpos: qpos[:, positions], 4, index, 100, {})

        return first_free_start(run, 4, index)

    rows = [sensor_statistics(simulated(i), reference_) for i in range(4)]
    assert np.nanmedian([row["contact distance/labels/contact"] for row in rows]) == pytest.approx(0.008, abs=0.002)


def test_a_hand_that_slides_over_the_object_has_no_contact_distance() -> None:
    episode = episodes("push")[0]
    touching = np.flatnonzero(episode.observations["contact"][:, 0] > 0.5)
    states = episode.states.copy()
    states[touching] += np.linspace(0.0, 0.08, len(touching))[:, None]
    values = [sensor_statistics(e, reference("push")) for e in (episode, replace(episode, states=states))]
    distances = [row["contact distance/labels/contact"] for row in values]
    assert abs(distances[0]) < 0.005
    assert np.isnan(distances[1])


def test_reference_survives_json() -> None:
    before = reference("push")
    again = Reference.from_json(before.to_json())
    np.testing.assert_array_equal(again.image, before.image)
    exact, stored = (sensor_statistics(episodes("push")[0], r) for r in (before, again))
    for name, value in exact.items():
        assert stored[name] == pytest.approx(value, abs=0.05, nan_ok=True), name


@pytest.mark.slow
@pytest.mark.parametrize("task", ["door-field", "push-field"])
def test_field_tasks(task: str) -> None:
    """A delay of haptics shows in the lag of commanded paths, despite noise and lost images."""
    simulate = load_task(task).simulate
    assert simulate is not None
    clean = [simulate(5, i, 60) for i in (1, 2)]
    rows = [sensor_statistics(episode, None) for episode in clean]
    assert 0.0 < np.mean([row["black/image/all"] for row in rows]) < 1.0
    lag = np.nanmean([row["lag/control/all"] for row in rows])
    assert abs(lag) <= 3.0
    delayed = [Faults.parse("delay=haptics:steps=4").apply(episode) for episode in clean]
    lags = [sensor_statistics(episode, None)["lag/control/all"] for episode in delayed]
    assert np.nanmean(lags) == pytest.approx(lag - 4.0, abs=0.5)


def test_empty_and_other_tasks() -> None:
    """Sensors that a task lacks have no statistics. Without a measured hand, controls are compared with the labels."""
    first = episodes("push")[0]
    bare = replace(first, observations={"sound": np.random.default_rng(0).normal(size=(100, 2)).astype(np.float32)})
    values = sensor_statistics(bare, reference("push"))
    of_sensors = {name.split("/")[1] for name in values if not name.startswith("control ")}
    assert of_sensors == {"sound x", "sound y"}


def test_axes_of_any_number_of_channels_are_named_and_localised() -> None:
    rng = np.random.default_rng(0)
    sizes = {"level": 1, "pair": 2, "joints": 5}
    task = Task("tank", (Component("x", "m"),), {k: (d,) for k, d in sizes.items()}, {k: (k,) for k in sizes}, 0, 0.1)
    readings = {key: rng.normal(size=(60, d)).astype(np.float32) for key, d in sizes.items()}
    for key, d in sizes.items():
        readings[key][20:40, d - 1] = readings[key][20, d - 1]
    episode = Episode(task, np.zeros((60, 1)), observations=readings)
    statistics = sensor_statistics(episode, None)
    for axis in ("level", "pair y", "joints 4"):
        assert statistics[f"stuck/{axis}/all"] > 0.2
        first, last = localise(f"stuck/{axis}/all", episode, None) or (0, 0)
        assert (abs(first - 20) <= 1, abs(last - 39) <= 1) == (True, True)
        for kind in ("noise", "level", "saturation"):
            localise(f"{kind}/{axis}/all", episode, None)

"""Statistics and causes of tasks whose contact is labelled, without a contact sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.covariate import CONTACT
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.diagnosis.catalog import CAUSES, causes_of
from beliefscope.inspect.diagnosis.causes.own_sensors import sensor_causes
from beliefscope.inspect.diagnosis.checks.sensors import biased_steps, localise, sensor_statistics
from beliefscope.inspect.diagnosis.checks.windows import window_values
from beliefscope.inspect.diagnosis.undo.readings import advance
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation

TASK = Task(
    name="bumper",
    components=(Component("x", "m"), Component("y", "m")),
    observations={"force": (3,), "torque": (3,), "battery": (1,)},
    modalities={"bumper": ("force", "torque"), "battery": ("battery",)},
    control_size=0,
    dt=0.1,
    covariates={"contact": CONTACT},
)


@pytest.fixture
def episode() -> Episode:
    """Contact from step 30 to 45 and from 80 to 120, with forces of 20 N; the torque follows the force."""
    rng = np.random.default_rng(0)
    contact = np.zeros(150, dtype=bool)
    contact[30:45] = contact[80:120] = True
    force = np.where(contact[:, None], [20.0, -10.0, 0.0] * rng.uniform(0.5, 1.5, (150, 1)), 0.0)
    torque = np.cross([0.0, 0.0, 0.1], force)
    readings = {"force": force, "torque": torque, "battery": np.full((150, 1), 12.0)}
    noisy = {key: values + rng.normal(0, 0.05, values.shape) for key, values in readings.items()}
    return Episode(TASK, np.zeros((150, 2)), observations=noisy, contact=contact)


def test_free_motion_has_no_labelled_contact(episode: Episode) -> None:
    values = sensor_statistics(Faults.parse("force_bias:x=5").apply(episode), None)
    assert values["level/force x/free motion"] == pytest.approx(5.0, abs=0.05)
    assert values["size/force/contact"] > 4.0, "of the steps in contact"
    assert biased_steps(Faults.parse("force_bias:x=5").apply(episode), "force", 0) is None, "all steps have the bias"
    later = Faults.parse("force_bias:x=5:from=60").apply(episode)
    assert localise("level/force x/free motion", later, None) == (60, 149)


def test_windows_have_their_labelled_contact(episode: Episode) -> None:
    levels = window_values(episode, None)["level/force x/free motion"]
    assert np.isnan(levels[8:10]).all(), "windows of steps 80 to 109"
    assert np.nanmax(np.abs(levels)) < 0.5


def test_delay_behind_labelled_contact(episode: Episode) -> None:
    assert sensor_statistics(episode, None)["contact lag/force/all"] == 0.0
    late = sensor_statistics(Faults.parse("delay=bumper:steps=5").apply(episode), None)
    assert (late["contact lag/force/all"], late["contact lag/torque/all"]) == (5.0, 5.0)
    assert np.isnan(late["contact lag/battery/all"]), "its readings do not depend on contact"
    unlabelled = replace(TASK, covariates={})
    assert not any("lag" in name for name in sensor_statistics(replace(episode, task=unlabelled), None))


def test_causes_of_delays_need_labels_without_a_sensor() -> None:
    names = {cause.name for cause in sensor_causes(TASK)}
    assert {"force.delay", "torque.delay", "battery.delay"} <= names
    hand = {"observations": TASK.observations | {"effector_position": (3,)}}
    with_hand = replace(TASK, **hand)
    assert "force.delay" in {cause.name for cause in sensor_causes(with_hand)}
    assert "force.delay" not in {cause.name for cause in sensor_causes(replace(with_hand, covariates={}))}, "no labels"


def test_noisy_sensors_are_dropped_with_their_modality() -> None:
    undo = {cause.name: cause.undo for cause in causes_of(TASK)}
    assert undo["force.noise"] == "drop bumper"
    assert undo["torque.bias"] == "tare torque|drop bumper"
    assert undo["image.frozen"] == "drop image", "the task has no image"
    assert {cause.name: cause for cause in causes_of(DOOR)}["force.noise"] in CAUSES


def test_delayed_sensors_are_advanced_by_their_own_delay(episode: Episode) -> None:
    late = Faults.parse("delay=bumper:steps=5").apply(episode)

    def still(*, observations: object, controls: np.ndarray) -> np.ndarray:
        return np.zeros((*controls.shape[:-1], 2))

    inputs = RunInputs(as_external(still, "still", TASK), {0: late}, 1, frozenset({0}))
    deviations = {
        name: Deviation(name, value, 0.0, 0.0, 0.0, 0.0, True, 5.0)
        for name, value in {"contact lag/force/all": 5.0, "contact lag/torque/all": 4.0}.items()
    }
    result = advance("force", inputs, deviations)
    assert result is not None
    observations = result.episodes[0].observations
    assert np.array_equal(observations["force"][:-5], episode.observations["force"][:-5])
    assert np.array_equal(observations["torque"][5:-5], episode.observations["torque"][4:-6])
    assert advance("battery", inputs, deviations) is None

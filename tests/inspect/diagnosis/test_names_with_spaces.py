"""Diagnoses of tasks whose sensors and components have names with spaces."""

from __future__ import annotations

from dataclasses import replace

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.diagnosis.undo.undo import brings_back
from beliefscope.inspect.diagnostics.statistic_kinds import sensor_of, unit_of

TASK = Task(
    name="train",
    components=(Component("rail x", "m", display=("m", 1.0)), Component("train speed", "m/s")),
    observations={"rad": (1,), "rad radar": (2,)},
    modalities={"radar": ("rad radar",), "rad": ("rad",)},
    control_size=0,
    dt=0.1,
)


def test_faults_of_sensors_have_their_names() -> None:
    faults = Faults.parse("sensor_frozen=rad radar:from=60")
    assert str(faults) == "sensor_frozen=rad radar:from=60"
    assert Faults.from_json(faults.to_json()) == faults


def test_statistics_have_the_units_of_their_components() -> None:
    assert unit_of("dynamics offset/rail x/all", TASK) == ("m", 1.0)
    assert unit_of("dynamics offset/train speed/all", TASK) == ("m/s", 1.0)
    assert unit_of("module bias/rad radar rail x/all", TASK) == ("m", 1.0)


def test_noise_has_the_unit_of_all_channels_of_its_modality() -> None:
    channels = {"rad radar": (Component("range", "m"), Component("height", "m"))}
    task = replace(TASK, channels=channels, modalities={"radar": ("rad radar",)})
    assert unit_of("measurement noise/radar/all", task) == task.channel("rad radar", 0).conversion
    assert unit_of("measurement noise//all", task) == ("", 1.0)
    observations = {**TASK.observations, "bearing": (1,)}
    mixed = replace(task, observations=observations, modalities={"radar": ("rad radar", "bearing")})
    assert unit_of("innovation std/radar/all", mixed) == ("", 1.0)


def test_subjects_of_statistics_are_sensors() -> None:
    assert sensor_of("rad radar", TASK.observations) == ("rad radar", "")
    assert sensor_of("rad radar x", TASK.observations) == ("rad radar", "x")
    assert sensor_of("rad", TASK.observations) == ("rad", "")
    assert sensor_of("labels x", TASK.observations) == ("labels", "x")


def test_sensors_are_dropped_by_their_names() -> None:
    assert not brings_back("drop rad radar")
    assert brings_back("rescale rad radar")

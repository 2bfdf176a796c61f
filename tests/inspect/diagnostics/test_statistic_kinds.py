"""Names and units of the statistics of healthy profiles."""

from __future__ import annotations

from dataclasses import replace

import pytest

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.covariate import CONTACT, Covariate
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnosis.diagnose import required_profile
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.diagnostics.statistic_kinds import (
    KINDS,
    OF_COMPONENTS,
    OF_KINDS,
    OF_READINGS,
    label_of,
    unit_of,
)


@pytest.mark.parametrize(
    ("phase", "where"),
    [
        ("contact", "in contact"),
        ("no beacon reading", "at steps with no beacon reading"),
        ("speed below 0.5 m\N{DIVISION SLASH}s", "at steps with speed below 0.5 m/s"),
        ("slide", "in phase slide"),
        ("x", "in x"),
    ],
)
def test_phases_of_own_tasks_are_named_in_sentences(phase: str, where: str) -> None:
    """Names of covariates and of their groups do not all follow *in*."""
    covariates = {
        "contact": CONTACT,
        "beacon reading": Covariate("boolean"),
        "speed": Covariate("continuous", cuts=(0.5,), unit="m/s"),
        "stage": Covariate("categorical", ("reach", "slide")),
    }
    task = replace(TASKS["door"], covariates=covariates)
    assert label_of(f"nees/fused/{phase}", task) == f"NEES/n of fused {where}"


@pytest.mark.parametrize(
    ("statistic", "label"),
    [
        ("weight/image hinge_x/contact", "effective weight of image (hinge x) in contact"),
        ("lag/image/all", "delay of image behind the other sensors"),
        ("lag/labels wrist_cam/all", "delay of the labels behind wrist cam"),
        ("reading scatter/gps x/all", "variation between episodes of the error of gps (x), relative to its noise,"),
        ("innovation bias/gps gps_fix x/all", "mean of the innovations, in standard deviations, of gps (gps fix x)"),
        ("innovation bias/baro baro/all", "mean of the innovations, in standard deviations, of baro"),
        ("lag/labels/all", "delay of the labels behind all modalities"),
        ("offset/labels x/all", "offset of the labels (x) from what all modalities measure"),
        ("offset/control x/all", "offset of control (x) from the measured hand"),
        ("opposed/control x/all", "evidence for the opposite sign of control (x)"),
    ],
)
def test_label(statistic: str, label: str) -> None:
    assert label_of(statistic) == label


GPS = Task("field", (Component("x", "m"),), {"gps": (2,)}, {"gps": ("gps",)}, 0, 0.1)


def test_without_contact_statistics_are_those_of_whole_episodes() -> None:
    assert label_of("size/gps x/contact", GPS) == "standard deviation of gps (x)"
    assert label_of("level/gps x/free motion", GPS) == "level of gps (x)"
    assert label_of("noise/gps x/extreme", GPS) == label_of("noise/gps x/extreme")


def test_channels_have_the_names_and_units_of_the_task() -> None:
    channels = {
        "radar": (Component("range", "m"), Component("bearing", "rad")),
        "speed": (Component("v", "m/s"),),
        "control": (Component("thrust", "N"), Component("rudder", "rad")),
    }
    task = replace(
        GPS,
        observations={"radar": (2,), "speed": (1,)},
        modalities={"sonar": ("radar", "speed")},
        control_size=2,
        channels=channels,
    )
    assert label_of("level/radar y/all", task) == "level of radar (bearing)"
    assert unit_of("level/radar y/all", task) == ("deg", pytest.approx(57.29577951308232))
    assert unit_of("drift/radar x/all", task) == ("cm/s", 100.0)
    assert unit_of("noise/speed/extreme", task) == ("m/s", 1.0)
    assert label_of("noise/speed/all", task) == "noise of speed"
    assert label_of("innovation bias/sonar radar x/all", task).endswith("of sonar (radar range)")
    assert label_of("innovation bias/sonar speed/all", task).endswith("of sonar (speed)")
    assert label_of("reading gain/control y/all", task).startswith("slope of control (rudder) on")
    assert unit_of("reading gain/control y/all", task) == ("", 1.0)  # a ratio
    assert label_of("module bias/sonar x/all", task) == "bias of the measurement model of sonar (x)"  # of the state


@pytest.mark.parametrize(
    ("statistic", "unit", "factor"),
    [
        ("error//contact", "cm", 100.0),
        ("angle error//all", "deg", 57.29577951308232),
        ("module bias/image angle/all", "deg", 57.29577951308232),
        ("module error/haptics hinge_x/all", "cm", 100.0),
        ("dynamics bias/hinge_y/contact", "cm", 100.0),
        ("contact distance/labels x/all", "cm", 100.0),
        ("offset/labels angle/all", "deg", 57.29577951308232),
        ("offset/control z/all", "cm", 100.0),
        ("compliance/force z/all", "mm/N", 1000.0),
        ("level/force y/free motion", "N", 1.0),
        ("drift/torque x/all", "N m/s", 1.0),
        ("level/pressure/all", "", 1.0),
        ("lag/image/all", "steps", 1.0),
        ("hand offset/image x/all", "px", 1.0),
        ("nees/fused/all", "", 1.0),
        ("dynamics slope/hinge_x/all", "", 1.0),
    ],
)
def test_unit(statistic: str, unit: str, factor: float) -> None:
    assert unit_of(statistic, TASKS["door"]) == (unit, pytest.approx(factor))


def test_kinds_with_units_exist_and_each_component_of_a_profile_has_a_unit() -> None:
    assert set(KINDS) >= OF_COMPONENTS | set(OF_KINDS) | set(OF_READINGS)
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    profile = required_profile(checkpoint)
    names = [name for name in profile.statistics if name.split("/")[0] in OF_COMPONENTS]
    assert len(names) > 10
    assert all(unit_of(name, checkpoint.task)[0] for name in names)


def test_a_deviation_is_written_in_its_unit() -> None:
    deviation = Deviation("error//all", 0.05, 0.017, 0.015, 0.021, 0.01, True, 3.0, TASKS["door"])
    assert deviation.text == "RMS position error is 5 cm, healthy 1.7 cm (1.5 to 2.1)"


def test_a_deviation_has_enough_digits_to_differ_from_the_healthy_range() -> None:
    deviation = Deviation("nees//all", 1.0043, 1.001, 0.9996, 1.0021, 0.01, True, 3.0)
    assert deviation.text == "NEES/n is 1.004, healthy 1.001 (0.9996 to 1.002)"
    constant = Deviation("nees//all", 0.07, 0.07, 0.07, 0.07, 1.0, False, 0.0)
    assert constant.text == "NEES/n is 0.07, healthy 0.07 (0.07 to 0.07)"


def test_the_numbers_of_a_filter_that_diverges_have_an_exponent() -> None:
    deviation = Deviation("error//all", 1.8e17, 0.017, 0.015, 0.021, 0.01, True, 3.0, TASKS["door"])
    assert deviation.text == "RMS position error is 1.8e+19 cm, healthy 1.7 cm (1.5 to 2.1)"


def test_names_with_spaces_are_whole() -> None:
    task = replace(
        GPS,
        components=(Component("Ort x", "m"), Component("Ort y", "m")),
        observations={"Rad Radar": (2,)},
        modalities={"Rad": ("Rad Radar",)},
    )
    assert label_of("level/Rad Radar x/all", task) == "level of Rad Radar (x)"
    assert label_of("dynamics bias/Ort y/all", task) == "bias of the dynamics model of Ort y"
    assert label_of("module bias/Rad Ort y/all", task) == "bias of the measurement model of Rad (Ort y)"

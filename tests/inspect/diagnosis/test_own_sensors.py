"""Causes in cameras, sensors and measurement models of a user's task, which the catalog does not name."""

from __future__ import annotations

from dataclasses import replace

import pytest

from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.diagnosis.catalog import causes_of
from beliefscope.inspect.diagnosis.scoring import applicable, explain, probabilities
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation

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

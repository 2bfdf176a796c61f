"""Planted lags and offsets of labels and modalities are found, on traces with known measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.diagnosis.checks.labels import label_statistics
from beliefscope.inspect.trace import Trace, trace


@pytest.fixture(scope="module")
def exact() -> Trace:
    """A trace of a door whose virtual sensors measure the true states."""
    with open_dataset("datasets/samples/door.h5") as data:
        result = trace(load_checkpoint(PRETRAINED / "door-crossmodal-ekf.safetensors"), data[140])
    return replace(result, observation_mean=np.repeat(result.episode.states[:, None], 2, axis=1))


def with_labels(run: Trace, states: np.ndarray) -> Trace:
    return replace(run, episode=replace(run.episode, states=states))


def delayed(values: np.ndarray, steps: int) -> np.ndarray:
    return values[np.maximum(np.arange(len(values)) - steps, 0)]


def test_clean_labels_have_neither_lag_nor_offset(exact: Trace) -> None:
    assert max(abs(value) for value in label_statistics(exact).values()) < 1e-6


@pytest.mark.parametrize("steps", [2, 5])
def test_late_labels_are_late_against_all_modalities(exact: Trace, steps: int) -> None:
    values = label_statistics(with_labels(exact, delayed(exact.episode.states, steps)))
    for name in ("lag/labels image/all", "lag/labels haptics/all", "lag/labels/all"):
        assert values[name] == steps


def test_a_late_modality_is_not_a_late_label(exact: Trace) -> None:
    assert exact.observation_mean is not None
    measured = exact.observation_mean.copy()
    measured[:, 0] = delayed(measured[:, 0], 3)
    values = label_statistics(replace(exact, observation_mean=measured))
    assert values["lag/labels image/all"] == -3.0
    assert values["lag/labels haptics/all"] == values["lag/labels/all"] == 0.0


def test_lags_do_not_depend_on_where_angles_wrap_around(exact: Trace) -> None:
    angle = exact.episode.states[:, 2].astype(np.float64)
    turned = (angle + np.pi - np.median(angle) + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(np.diff(turned)).max() > np.pi, "the labels wrap around"
    states = np.column_stack([exact.episode.states[:, :2], turned]).astype(np.float32)
    measured = np.repeat(states[:, None], 2, axis=1)
    measured[:, 0] = delayed(states, 3)
    values = label_statistics(replace(with_labels(exact, states), observation_mean=measured))
    assert (values["lag/labels image/all"], values["lag/labels haptics/all"]) == (-3.0, 0.0)


def test_offsets_are_shared_only_if_all_modalities_have_them(exact: Trace) -> None:
    assert exact.observation_mean is not None
    offset = np.array([0.02, -0.01, 0.1], dtype=np.float32)
    values = label_statistics(with_labels(exact, exact.episode.states + offset))
    for component, amount in zip(("hinge_x", "hinge_y", "angle"), offset, strict=True):
        assert values[f"offset/labels {component}/all"] == pytest.approx(amount, abs=1e-6)
    measured = exact.observation_mean.copy()
    measured[:, 0] -= offset
    values = label_statistics(replace(exact, observation_mean=measured))
    assert values["offset/labels hinge_x/all"] == 0.0


def test_small_tasks_and_components_that_are_not_measured_do_not_hide_a_delay() -> None:
    """A position that moves by 5 mm, with an angle that a camera does not see."""
    parts = (Component("x", "m"), Component("y", "m"), Component("yaw", "rad"))
    task = Task("peg", parts, {"camera": (8, 8)}, {"camera": ("camera",)}, 0, 0.05, map_half_width=0.01, warmup=0)
    rng = np.random.default_rng(0)
    walk = np.cumsum(np.repeat(rng.normal(0.0, [5e-4, 5e-4, 5e-3], (20, 3)), 4, axis=0), axis=0)
    states = np.clip(walk - walk.mean(0), [-4e-3, -4e-3, -1.0], [4e-3, 4e-3, 1.0]).astype(np.float32)
    images = np.zeros((80, 8, 8), np.uint8)
    measured = delayed(states, 4)
    measured[:, 2] = rng.normal(0.0, 0.3, 80)
    covariance = np.broadcast_to(np.eye(3), (80, 1, 3, 3))
    outputs = {"estimate_mean": measured, "modality_mean": measured[:, None], "modality_covariance": covariance}

    def camera(*, observations: object, controls: object) -> dict[str, np.ndarray]:
        return outputs

    episode = Episode(task, states, observations={"camera": images})
    adapter = Adapter(camera, batched=False, modalities=("camera",), initial_std=(1.0, 1.0, 1.0))
    values = label_statistics(trace(as_external(adapter, "camera", task), episode))
    assert values["lag/labels camera/all"] == pytest.approx(-4.0, abs=1.0)

"""Rotations as state components: closed forms, errors, NEES and means; a recorded attitude filter."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

from beliefscope.datasets import rotations
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Component, Task, rotation
from beliefscope.datasets.task_json import task_from_json, task_to_json
from beliefscope.filters.catalog import build
from beliefscope.filters.evaluate import metrics
from beliefscope.filters.external.derived_values import derived
from beliefscope.filters.filter import Architecture
from beliefscope.filters.names import check_trainable, pretrained_path
from beliefscope.filters.start_offset import StartOffset
from beliefscope.inspect.diagnostics.consistency import consistency
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.traces.live_file import load_live

POSE = Task(
    "pose",
    (Component("x", "m"), Component("y", "m"), *rotation("attitude"), Component("speed", "m/s")),
    {"gps": (2,)},
    {"gps": ("gps",)},
    0,
    0.1,
)


def _random(rng: np.random.Generator, count: int) -> np.ndarray:
    return rotations.to_vector(rng.normal(size=(count, 4)))


def test_closed_forms() -> None:
    rng = np.random.default_rng(0)
    quarter = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    assert np.allclose(rotations.to_vector(quarter), [0, 0, np.pi / 2])
    q = rng.normal(size=(200, 4))
    assert np.array_equal(rotations.to_vector(q), rotations.to_vector(-q)), "a quaternion and its negative"
    assert np.allclose(rotations.to_vector([1.0, 1e-14, 0, 0]), [2e-14, 0, 0], rtol=1e-9, atol=0)
    vectors = _random(rng, 200)
    assert np.allclose(rotations.to_vector(rotations.to_quaternion(vectors)), vectors)
    assert (np.linalg.norm(vectors, axis=1) <= np.pi + 1e-12).all()
    offsets = 0.9 * _random(rng, 200)
    assert np.allclose(rotations.difference(rotations.add(vectors, offsets), vectors), offsets)
    assert np.allclose(rotations.difference(vectors, offsets), -rotations.difference(offsets, vectors)), "e = -e'"
    axis, angles = np.array([0.6, 0.0, 0.8]), rng.uniform(-3, 3, (2, 100, 1))
    plane = Task("plane", (Component("yaw", "rad"),), {"gps": (2,)}, {"gps": ("gps",)}, 0, 0.1)
    same = rotations.difference(angles[0] * axis, angles[1] * axis) @ axis
    assert np.allclose(same, plane.difference(angles[0], angles[1])[:, 0]), "a common axis: the wrapped angle"


def test_the_exponential_has_the_derivative_of_the_rotation() -> None:
    """d(R v)/d offset = -R [v]x for R exp(offset), by central differences."""
    vector, v, step = np.array([0.4, -1.1, 0.7]), np.array([0.3, 0.5, -0.2]), 1e-6

    def rotated(w: np.ndarray) -> np.ndarray:
        q = rotations.to_quaternion(w)
        conjugate = q * (1, -1, -1, -1)
        return rotations.multiply(rotations.multiply(q, np.concatenate([[0], v])), conjugate)[1:]

    numeric = [
        (rotated(rotations.add(vector, e)) - rotated(rotations.add(vector, -e))) / 2e-6 for e in step * np.eye(3)
    ]
    matrix = np.stack([np.cross(np.array(e), v) for e in np.eye(3)])  # rows: e x v
    q = rotations.to_quaternion(vector)
    expected = [
        rotations.multiply(rotations.multiply(q, np.concatenate([[0], row])), q * (1, -1, -1, -1))[1:] for row in matrix
    ]
    assert np.allclose(numeric, expected, atol=1e-8)


def test_nees_is_chi_square_and_does_not_depend_on_the_world_frame() -> None:
    rng, count = np.random.default_rng(1), 20000
    root = np.diag([0.02, 0.03, 0.2, 0.3, 0.5, 0.1]) + 0.01 * rng.normal(size=(6, 6))
    truth = np.concatenate([rng.normal(size=(count, 2)), _random(rng, count), rng.normal(size=(count, 1))], axis=1)
    noise = rng.normal(size=(count, 6)) @ root.T
    estimate = truth + noise
    estimate[:, 2:5] = rotations.add(truth[:, 2:5], noise[:, 2:5])
    covariance = torch.from_numpy(np.broadcast_to(root @ root.T, (count, 6, 6)).copy())
    error = POSE.difference(estimate, truth)
    nees = metrics(POSE, torch.from_numpy(error), covariance).nees
    assert abs(nees - 1.0) < 4 * np.sqrt(2 / 6 / count)
    frame = np.array([1.0, -2.0, 0.5])
    turned = [rotations.add(np.broadcast_to(frame, (count, 3)), states[:, 2:5]) for states in (estimate, truth)]
    assert np.allclose(rotations.difference(*turned), error[:, 2:5], atol=1e-9)
    as_quaternions = [
        np.concatenate([s[:, :2], sign * rotations.to_quaternion(s[:, 2:5]), s[:, 5:]], axis=1)
        for s, sign in ((estimate, 1), (truth, -1))
    ]
    assert np.allclose(POSE.difference(*map(POSE.states, as_quaternions)), error, atol=1e-9)


def test_particle_moments_beyond_half_a_turn() -> None:
    rng = np.random.default_rng(2)
    centre = np.array([np.pi - 0.01, 0.0, 0.0])  # the particles' vectors lie on both sides of the jump at pi
    offsets = rng.normal(size=(1, 4000, 3)) * [0.1, 0.2, 0.05]
    particles = np.concatenate([np.zeros((1, 4000, 2)), rotations.add(centre, offsets), np.ones((1, 4000, 1))], axis=-1)
    values = {
        "estimate_mean": torch.zeros(1, 6),
        "particles": torch.from_numpy(particles),
        "log_weights": torch.full((1, 4000), -np.log(4000), dtype=torch.float64),
        "prior_log_weights": torch.full((1, 4000), -np.log(4000), dtype=torch.float64),
        "log_likelihood": torch.zeros(1, 1, 4000, dtype=torch.float64),
    }
    result = derived(values, POSE)
    mean, covariance = result["modality_mean"][0, 0].numpy(), result["estimate_covariance"][0].numpy()
    assert np.linalg.norm(rotations.difference(mean[2:5], centre)) < 0.02
    assert np.allclose(np.sqrt(np.diag(covariance)[2:5]), [0.1, 0.2, 0.05], rtol=0.05)


def test_definition_main_error_and_refusals() -> None:
    attitude = Task("attitude", rotation("attitude"), {"mag": (3,)}, {"mag": ("mag",)}, 0, 0.1)
    assert task_from_json(task_to_json(attitude)) == attitude
    assert (attitude.main_error.label, attitude.main_error.indices) == ("attitude (deg)", (0, 1, 2))
    assert POSE.main_error.indices == (0, 1)
    broken = task_to_json(attitude) | {"components": task_to_json(attitude)["components"][:2]}
    with pytest.raises(BadInput, match="rotation 'attitude' has 2 components"):
        task_from_json(broken)
    with pytest.raises(BadInput, match="quaternion of 'attitude' has norm 2, expected 1"):
        attitude.states(np.array([[2.0, 0, 0, 0]]))
    with pytest.raises(BadInput, match=r"20deg.*'attitude' is a rotation"):
        StartOffset.parse("20deg", attitude)
    with pytest.raises(BadInput, match="built-in filters estimate vectors; task 'attitude'"):
        build(Architecture(attitude, "ekf", "none", ("mag",)))
    for refuse in (lambda: pretrained_path(attitude, "crossmodal-ekf"), lambda: check_trainable(attitude, "", "lstm")):
        with pytest.raises(BadInput, match="built-in filters estimate vectors; task 'attitude'"):
            refuse()


@pytest.mark.slow
@pytest.mark.long
def test_a_recorded_attitude_filter_is_consistent(tmp_path: Path) -> None:
    example = runpy.run_path(str(Path(__file__).resolve().parents[2] / "examples" / "attitude.py"))
    traces = []
    for seed in range(6):
        example["run"](str(tmp_path / str(seed)), 100, seed)
        traces.append(load_live(tmp_path / str(seed) / "attitude.live"))
    assert max(np.degrees(measures.main_error(trace)[10:, -1]).max() for trace in traces) < 6.0
    low, high = consistency(traces).entry("fused").interval
    assert low < 1.0 < high
    estimates = traces[0].task.near(traces[0].estimate_mean, traces[0].episode.states)
    assert np.allclose(estimates - traces[0].episode.states, measures.errors(traces[0])[:, -1], atol=1e-5)

"""Statistics of external filters whose state is a rotation in space, by closed forms and finite differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.datasets import rotations
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.diagnosis.checks.modules import model_statistics

DT, GYRO, NOISE, STEPS = 0.05, 0.1, 0.03, 120  # s; rad/s; noise of the unit vectors of gravity and magnetic field
WORLD = {"gravity": np.array([0.0, 0.0, 1.0]), "field": np.array([0.6, 0.0, -0.8])}
TASK = bs.Task(
    name="attitude",
    components=bs.rotation("attitude"),
    observations=dict.fromkeys(WORLD, (3,)),
    modalities={name: (name,) for name in WORLD},
    control_size=3,  # gyroscope, rad/s
    dt=DT,
    warmup=5,
)
AXES = ("attitude_x", "attitude_y", "attitude_z")


def body(states: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A vector of the world in the body axes of rotation vectors (..., 3)."""
    q = rotations.to_quaternion(states)
    pure = np.concatenate([[0.0], vector])
    return rotations.multiply(rotations.multiply(q * (1, -1, -1, -1), np.broadcast_to(pure, q.shape)), q)[..., 1:]


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def turn(seed: int) -> bs.Episode:
    """Beyond half a turn about an axis, where rotation vectors jump."""
    rng = np.random.default_rng(seed)
    rates = np.cumsum(rng.normal(0.0, 0.4, (STEPS, 3)), axis=0)
    states = [rng.normal(0.0, 1.0, 3)]
    for rate in rates:
        states.append(rotations.add(states[-1], DT * rate))
    truth = np.array(states[1:])
    readings = {name: body(truth, v) + rng.normal(0.0, NOISE, (STEPS, 3)) for name, v in WORLD.items()}
    return bs.Episode(TASK, truth, rates + rng.normal(0.0, GYRO, rates.shape), readings, seed=seed, split="test")


class Kalman:
    """Multiplicative EKF. jacobian: factor of the angle in F. gain: factor of the gyroscope in the dynamics."""

    def __init__(self, jacobian: float = 1.0, gain: float = 1.0) -> None:
        self.jacobian, self.gain = jacobian, gain

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.x, self.p = np.array(mean, float), np.array(covariance, float)

    def forward(self, *, observations: Any, controls: Any) -> dict[str, Any]:
        angle = DT * self.gain * np.asarray(controls, float)
        f = np.stack([body(self.jacobian * angle, axis) for axis in np.eye(3)], axis=1)  # R(angle)^T
        self.x = rotations.add(self.x, angle)
        self.p = f @ self.p @ f.T + (DT * GYRO) ** 2 * np.eye(3)
        means, covariances, innovations, sizes = [], [], [], []
        for name, vector in WORLD.items():
            h = skew(body(self.x, vector))
            s = h @ self.p @ h.T + NOISE**2 * np.eye(3)
            innovation = np.asarray(observations[name], float) - body(self.x, vector)
            for values, value in zip(
                (means, covariances, innovations, sizes), (self.x, self.p, innovation, s), strict=True
            ):
                values.append(value)
            k = self.p @ h.T @ np.linalg.inv(s)
            self.x, self.p = rotations.add(self.x, k @ innovation), self.p - k @ h @ self.p
        return {
            "estimate_mean": self.x,
            "estimate_covariance": self.p,
            "predicted_mean": np.stack(means),
            "predicted_covariance": np.stack(covariances),
            "innovation": np.stack(innovations),
            "innovation_covariance": np.stack(sizes),
        }


class Particles:
    """Bootstrap filter. offset: rad, about the vertical axis of the world, by which the field is expected elsewhere."""

    def __init__(self, offset: float = 0.0) -> None:
        self.field = body(np.array([0.0, 0.0, -offset]), WORLD["field"])

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.rng = np.random.default_rng(0)
        self.x = rotations.add(np.array(mean, float), self.rng.multivariate_normal(np.zeros(3), covariance, 200))

    def forward(self, *, observations: Any, controls: Any) -> dict[str, Any]:
        angle = DT * np.asarray(controls, float) + DT * GYRO * self.rng.standard_normal(self.x.shape)
        self.x = rotations.add(self.x, angle)
        prior = np.full(len(self.x), -np.log(len(self.x)))
        expected = {**WORLD, "field": self.field}
        errors = [np.square(observations[name] - body(self.x, v)).sum(-1) for name, v in expected.items()]
        likelihood = -0.5 * np.stack(errors) / NOISE**2
        posterior = prior + likelihood.sum(0)
        posterior -= np.logaddexp.reduce(posterior)
        values = {"particles": self.x, "log_weights": posterior, "prior_log_weights": prior}
        values |= {"log_likelihood": likelihood, "estimate_mean": rotations.mean(self.x, np.exp(posterior))}
        self.x = self.x[self.rng.choice(len(self.x), len(self.x), p=np.exp(posterior))]
        return values


def statistics(module: Kalman | Particles, seed: int = 0) -> dict[str, float]:
    adapter = bs.Adapter(module, batched=False, modalities=tuple(WORLD), initial_std=(0.1, 0.1, 0.1))
    checkpoint = as_external(adapter, "attitude", TASK)
    return model_statistics(bs.trace(checkpoint, [turn(seed)], 0), checkpoint)


def test_moved_is_the_inverse_of_difference() -> None:
    states, change = turn(0).states, np.random.default_rng(0).normal(0.0, 0.5, (STEPS, 3))
    np.testing.assert_allclose(TASK.difference(TASK.moved(states, change), states), change, atol=1e-9)


@pytest.mark.first(1)
@pytest.mark.parametrize("jacobian", [1.0, -1.0])
def test_jacobians_are_derivatives_by_the_error_in_body_axes(jacobian: float) -> None:
    """With the opposite rotation, F is ``R(angle)`` instead of its transpose, which differs with the angle."""
    values = statistics(Kalman(jacobian))
    errors = [values[f"prediction jacobian/{axis}/all"] for axis in AXES]
    assert max(errors) < 1e-3 if jacobian == 1.0 else max(errors) > 0.2
    np.testing.assert_allclose([values[f"measurement jacobian/{name}/all"] for name in WORLD], 0.0, atol=0.02)
    assert min(values[f"correction slope/{name}/all"] for name in WORLD) > 0.98


@pytest.mark.first(1)
@pytest.mark.parametrize("gain", [1.0, 2.0])
def test_dynamics_of_rotations_have_the_slopes_and_the_noise_of_their_axes(gain: float) -> None:
    """From true states, whatever the updates do."""
    values = statistics(Kalman(gain=gain))
    for axis, control in zip(AXES, "xyz", strict=True):
        assert values[f"dynamics slope/{axis}/all"] == pytest.approx(gain, abs=0.05)
        assert values[f"dynamics effect/control {control}/{axis}"] == pytest.approx(1.0 / gain, abs=0.1)
        assert values[f"process noise/{axis}/all"] == pytest.approx(DT * GYRO, rel=0.01)


@pytest.mark.long
def test_an_expected_reading_that_is_turned_moves_the_particles() -> None:
    """About the vertical axis of the world; not with the right one, up to the noise of the readings."""
    right, turned = (
        np.array([values[f"likelihood offset/field {axis}/all"] for axis in AXES])
        for values in (statistics(Particles(offset)) for offset in (0.0, 0.3))
    )
    assert np.linalg.norm(turned) > 5.0 * np.linalg.norm(right)

"""Record an attitude filter whose state is a unit quaternion: gyroscope, accelerometer and magnetometer, in NumPy.

python examples/attitude.py [FOLDER]; then: beliefscope inspect FOLDER/attitude.live
"""

import sys

import numpy as np

import beliefscope as bs

DT, GYRO, NOISE = 0.02, 0.05, 0.03  # s; rad/s; noise of the unit vectors of gravity and of the magnetic field
WORLD = {"accelerometer": np.array([0.0, 0.0, 1.0]), "magnetometer": np.array([0.6, 0.0, -0.8])}
TASK = bs.Task(
    name="attitude",
    components=bs.rotation("attitude"),
    observations=dict.fromkeys(WORLD, (3,)),
    modalities={name: (name,) for name in WORLD},
    control_size=3,  # gyroscope, rad/s
    dt=DT,
    warmup=0,
)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of two quaternions (w, x, y, z)."""
    return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


def turn(vector: np.ndarray) -> np.ndarray:
    """Quaternion of a rotation vector."""
    half = np.linalg.norm(vector) / 2
    return np.concatenate([[np.cos(half)], np.sinc(half / np.pi) * vector / 2])


def body(q: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A vector of the world in body axes."""
    conjugate = q * (1, -1, -1, -1)
    return product(product(conjugate, np.concatenate([[0], vector])), q)[1:]


def skew(v: np.ndarray) -> np.ndarray:
    """Matrix of the cross product with v."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def run(folder: str, steps: int = 500, seed: int = 0) -> None:
    """Multiplicative EKF: the error is a rotation vector in body axes, so its covariance is 3 x 3."""
    rng = np.random.default_rng(seed)
    truth, p = turn(rng.normal(0, 1, 3)), np.diag([0.04, 0.04, 0.04])
    q = product(truth, turn(rng.multivariate_normal(np.zeros(3), p)))
    with bs.LiveRecorder("attitude", task=TASK, folder=folder, filter="mekf") as live:
        for t in range(steps):
            rate = np.array([np.sin(0.02 * t), np.cos(0.013 * t), 0.7])
            truth, gyro = product(truth, turn(DT * rate)), rate + rng.normal(0, GYRO, 3)
            readings = {name: body(truth, v) + rng.normal(0, NOISE, 3) for name, v in WORLD.items()}
            step = turn(DT * gyro)
            f = np.stack([body(step, axis) for axis in np.eye(3)], axis=1)
            q, p = product(q, step), f @ p @ f.T + (DT * GYRO) ** 2 * np.eye(3)
            innovations, covariances = [], []
            for name, v in WORLD.items():
                h = skew(body(q, v))
                s = h @ p @ h.T + NOISE**2 * np.eye(3)
                gain, innovation = p @ h.T @ np.linalg.inv(s), readings[name] - body(q, v)
                q, p = product(q, turn(gain @ innovation)), (np.eye(3) - gain @ h) @ p
                innovations.append(innovation)
                covariances.append(s)
            estimate = {"estimate_mean": q / np.linalg.norm(q), "estimate_covariance": (p + p.T) / 2}
            estimate |= {"innovation": innovations, "innovation_covariance": covariances}
            live.step(estimate, readings, gyro, truth=truth)
    print(live.path)


if __name__ == "__main__":
    run(sys.argv[1] if len(sys.argv) > 1 else "live")

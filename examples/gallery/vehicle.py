"""Data of the gallery: a vehicle with GPS, which has outages and outliers, and a wheel speed sensor.

python examples/gallery/vehicle.py vehicle.h5
"""

import sys

import numpy as np

from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import write_dataset
from beliefscope.datasets.task import Component, Task

DT, ACCELERATION, GPS, SPEED = 0.1, 0.5, 0.3, 0.05  # s; standard deviations in m/s^2, m, m/s

TASK = Task(
    name="vehicle",
    components=(Component("x", "m"), Component("y", "m"), Component("vx", "m/s"), Component("vy", "m/s")),
    observations={"gps": (2,), "fix": (1,), "speed": (1,)},
    modalities={"gps": ("gps", "fix"), "speed": ("speed",)},
    control_size=1,
    dt=DT,
    map_components=("x", "y"),
    map_half_width=2.0,
    positions={"gps": (0, 1)},
    warmup=5,
    covariates={"fix": Covariate("boolean")},
)

F = np.eye(4) + DT * np.eye(4, k=2)
Q = ACCELERATION**2 * np.kron([[DT**4 / 4, DT**3 / 2], [DT**3 / 2, DT**2]], np.eye(2)) + 1e-9 * np.eye(4)
H = {"gps": np.eye(2, 4), "speed": np.eye(1, 4, 2)}  # the speed sensor measures vx
R = {"gps": GPS**2 * np.eye(2), "speed": SPEED**2 * np.eye(1)}
P0 = 0.1 * np.eye(4)


def drive(seed: int, steps: int = 120, gap: tuple[int, int] | None = None, outliers: float = 0.0) -> Episode:
    """A linear-Gaussian trajectory from the origin.

    gap: steps without a GPS fix, which repeat the last reading. outliers: share of GPS readings that are off by 5 m.
    """
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(Q)
    states = np.zeros((steps, 4))
    for t in range(1, steps):
        states[t] = F @ states[t - 1] + root @ rng.standard_normal(4)
    gps = states[:, :2] + GPS * rng.standard_normal((steps, 2))
    speed = states[:, 2:3] + SPEED * rng.standard_normal((steps, 1))
    gps[rng.random(steps) < outliers] += 5.0
    fix = np.ones(steps, np.float32)
    if gap is not None:
        gps[slice(*gap)], fix[slice(*gap)] = gps[gap[0] - 1], 0.0
    observations = {"gps": gps, "fix": fix[:, None], "speed": speed}
    return Episode(
        task=TASK,
        states=states.astype(np.float32),
        controls=np.zeros((steps, 1), np.float32),
        observations={key: value.astype(np.float32) for key, value in observations.items()},
        contact=np.zeros(steps, bool),
        qpos=np.zeros((steps, 0), np.float32),
        dt=DT,
        seed=seed,
        split="test",
        covariates={"fix": fix},
    )


if __name__ == "__main__":
    write_dataset(sys.argv[1], TASK, (drive(seed, 300, (100, 160), 0.05) for seed in range(10)))

"""A custom task without MuJoCo: a ball on a table, observed by a small camera and two microphones.

python examples/own_task.py own.h5
beliefscope train examples/own_task.py:TASK --filter crossmodal-ekf --data own.h5 -o own.safetensors
"""

import sys

import numpy as np

import beliefscope as bs

DT, SIDE = 0.1, 0.5  # s per step; half the table's side, m
MICROPHONES = np.array([(-SIDE, -SIDE), (SIDE, -SIDE)])

TASK = bs.Task(
    name="ball",
    components=(bs.Component("x", "m"), bs.Component("y", "m")),
    observations={"image": (16, 16), "distances": (2,), "loud": (1,)},
    modalities={"image": ("image",), "sound": ("distances", "loud")},
    control_size=2,
    dt=DT,
    map_components=("x", "y"),
    map_half_width=0.2,
    covariates={"wind": bs.Covariate("boolean")},
)


def roll(seed: int, steps: int = 60) -> bs.Episode:
    """Wind (the control, m/s) moves the ball, which bounces off the edges; without wind its sound is uninformative."""
    rng = np.random.default_rng(seed)
    wind = np.repeat(rng.normal(0, 0.3, (steps // 10 + 1, 2)), 10, axis=0)[:steps]
    path = np.cumsum(DT * wind + rng.normal(0, 0.01, (steps, 2)), axis=0) + rng.uniform(-0.3, 0.3, 2)
    position = np.abs((path + SIDE) % (4 * SIDE) - 2 * SIDE) - SIDE  # reflected at the edges
    x, y = np.meshgrid(np.linspace(-SIDE, SIDE, 16), np.linspace(SIDE, -SIDE, 16))
    squared = (x - position[:, :1, None]) ** 2 + (y - position[:, 1:, None]) ** 2
    image = (200 * np.exp(-squared / 0.005) + rng.uniform(0, 50, squared.shape)).astype(np.uint8)
    loud = np.linalg.norm(wind, axis=1, keepdims=True) > 0.2
    noise = rng.normal(0, np.where(loud, 0.01, 0.3), (steps, 2))
    distances = np.linalg.norm(position[:, None] - MICROPHONES, axis=-1) + noise
    return bs.Episode(
        task=TASK,
        states=position,
        controls=wind,
        observations={"image": image, "distances": distances, "loud": loud.astype(np.float32)},
        covariates={"wind": loud[:, 0].astype(np.float32)},  # its steps are shaded in every view
        seed=seed,
        split={8: "val", 9: "test"}.get(seed % 10, "train"),
    )


if __name__ == "__main__":
    bs.save_dataset([roll(seed) for seed in range(100)], sys.argv[1])

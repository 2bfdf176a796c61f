"""A task of your own, without MuJoCo: a ball rolls over a table, seen by a small camera and heard by two microphones.

python examples/own_task.py own.h5
beliefscope train examples/own_task.py:TASK --filter crossmodal-ekf --data own.h5 -o own.safetensors
beliefscope record examples/own_task.py:TASK --filter own.safetensors --data own.h5 -o own.rrd
"""

import sys

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import write_dataset
from beliefscope.datasets.task import Component, Task

DT, SIDE = 0.1, 0.5  # s a step; half the table's side, m
MICROPHONES = np.array([(-SIDE, -SIDE), (SIDE, -SIDE)])

TASK = Task(
    name="ball",
    components=(Component("x", "m"), Component("y", "m")),
    observations={"image": (16, 16), "distances": (2,), "loud": (1,)},
    modalities={"image": ("image",), "sound": ("distances", "loud")},
    control_size=2,
    dt=DT,
    map_components=("x", "y"),
    map_half_width=0.2,
)


def roll(seed: int, steps: int = 60) -> Episode:
    """Wind (the control, m/s) moves the ball, which bounces off the edges; in a calm its sound is next to nothing."""
    rng = np.random.default_rng(seed)
    wind = np.repeat(rng.normal(0, 0.3, (steps // 10 + 1, 2)), 10, axis=0)[:steps]
    way = np.cumsum(DT * wind + rng.normal(0, 0.01, (steps, 2)), axis=0) + rng.uniform(-0.3, 0.3, 2)
    at = np.abs((way + SIDE) % (4 * SIDE) - 2 * SIDE) - SIDE  # folded back at the edges
    x, y = np.meshgrid(np.linspace(-SIDE, SIDE, 16), np.linspace(SIDE, -SIDE, 16))
    away = (x - at[:, :1, None]) ** 2 + (y - at[:, 1:, None]) ** 2
    picture = 200 * np.exp(-away / 0.005) + rng.uniform(0, 50, away.shape)
    loud = np.linalg.norm(wind, axis=1, keepdims=True) > 0.2
    heard = np.linalg.norm(at[:, None] - MICROPHONES, axis=-1) + rng.normal(0, np.where(loud, 0.01, 0.3), (steps, 2))
    seen = {"image": picture.astype(np.uint8), "distances": heard.astype(np.float32), "loud": loud.astype(np.float32)}
    return Episode(
        task=TASK.name,
        states=at.astype(np.float32),
        controls=wind.astype(np.float32),
        observations=seen,
        contact=loud[:, 0],  # marked in every view
        qpos=np.zeros((steps, 0), np.float32),  # no replay
        dt=DT,
        seed=seed,
        split={8: "val", 9: "test"}.get(seed % 10, "train"),
    )


if __name__ == "__main__":
    write_dataset(sys.argv[1], TASK, (roll(seed) for seed in range(100)))

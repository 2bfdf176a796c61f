"""A custom task with a heading that wraps around: a mobile robot under a ceiling camera, with a compass.

python examples/mobile_robot.py robot.h5
beliefscope train examples/mobile_robot.py:TASK --filter crossmodal-ekf --data robot.h5 -o robot.safetensors
"""

import sys

import numpy as np

import beliefscope as bs

DT, SIDE, PIXELS = 0.1, 2.0, 24  # s per step; half the side of the room, m; of the camera

TASK = bs.Task(
    name="robot",
    components=(bs.Component("x", "m"), bs.Component("y", "m"), bs.Component("heading", "rad", wraps=True)),
    observations={"image": (PIXELS, PIXELS), "compass": (2,)},
    modalities={"image": ("image",), "compass": ("compass",)},
    control_size=2,
    dt=DT,
    map_half_width=0.5,
    channels={
        "compass": (bs.Component("cosine", ""), bs.Component("sine", "")),
        "control": (bs.Component("speed", "m/s"), bs.Component("turn_rate", "rad/s")),
    },
)


def path(rng: np.random.Generator, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States (T, 3) and controls (T, 2), speed in m/s and turn rate in rad/s, which the wheels follow with an error."""
    controls = np.repeat(np.column_stack([rng.uniform(0.2, 0.8, steps), rng.normal(0.0, 1.5, steps)])[::10], 10, axis=0)
    state = np.array([*rng.uniform(-1.2, 1.2, 2), rng.uniform(-np.pi, np.pi)])
    states = np.empty((steps, 3))
    for t, (speed, turn) in enumerate(controls + rng.normal(0.0, (0.05, 0.1), (steps, 2))):
        step = DT * np.array([speed * np.cos(state[2]), speed * np.sin(state[2]), turn])
        if np.abs(state[:2] + step[:2]).max() > 1.7:  # at a wall it only turns
            controls[t], step = (0.0, 3.0), np.array([0.0, 0.0, 3.0 * DT])
        states[t] = state = state + step
    states[:, 2] = (states[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return states, controls


def drive(seed: int, steps: int = 100) -> bs.Episode:
    """The camera sees the robot as a spot with a small spot at its front."""
    rng = np.random.default_rng(seed)
    states, controls = path(rng, steps)
    x, y = np.meshgrid(np.linspace(-SIDE, SIDE, PIXELS), np.linspace(SIDE, -SIDE, PIXELS))
    image = rng.uniform(0.0, 30.0, (steps, PIXELS, PIXELS))
    for distance, size, gray in ((0.0, 0.2, 120.0), (0.35, 0.12, 100.0)):
        u, v = states[:, :2].T + distance * np.array([np.cos(states[:, 2]), np.sin(states[:, 2])])
        image += gray * np.exp(-0.5 * ((x - u[:, None, None]) ** 2 + (y - v[:, None, None]) ** 2) / size**2)
    direction = states[:, 2] + rng.normal(0.0, 0.15, steps)
    compass = np.column_stack([np.cos(direction), np.sin(direction)])
    return bs.Episode(
        task=TASK,
        states=states,
        controls=controls,
        observations={"image": image.astype(np.uint8), "compass": compass},
        seed=seed,
        split={8: "val", 9: "test"}.get(seed % 10, "train"),
    )


if __name__ == "__main__":
    bs.save_dataset([drive(seed) for seed in range(100)], sys.argv[1])

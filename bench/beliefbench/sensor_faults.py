"""Causes planted in data: sensor readings, controls and labels of fresh episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.fault import delay_steps
from beliefscope.datasets.faults.injection import Faults

FORCE_SCALE = {"door": 20.0, "push": 1.2}
"""Standard deviation of the force of a task, N; magnitudes of additive force faults are its multiples."""

TORQUE_SCALE = {"door": 2.0, "push": 0.1}
"""Standard deviation of the torque of a task, N m."""

ONSETS = (0, 0, 30)
"""First steps of lasting faults, drawn with equal probability."""

SOME_EPISODES = 0.25
"""Probability that a sensor fault affects every second episode only."""


@dataclass(frozen=True)
class SensorCause:
    """A cause planted with ``--faults``.

    Attributes:
        templates: texts of faults, one is drawn; ``{m}`` is the magnitude, ``{f}`` and ``{t}``
            the same times ``FORCE_SCALE`` and ``TORQUE_SCALE``.
        magnitudes: four levels, from mild to severe.
        onset: whether the magnitude is the first step, instead of one drawn from ``ONSETS``.
    """

    templates: tuple[str, ...]
    magnitudes: tuple[float | str, ...]
    onset: bool = False

    def faults(self, task: str, magnitude: float | str, rng: np.random.Generator) -> Faults:
        template = self.templates[int(rng.integers(len(self.templates)))]
        first = magnitude if self.onset else ONSETS[int(rng.integers(len(ONSETS)))]
        object_ = task.removesuffix("-field")
        size = magnitude if isinstance(magnitude, float | int) else 0.0
        force, torque = size * FORCE_SCALE[object_], size * TORQUE_SCALE[object_]
        template = template.replace("{contact}", {"door": "0", "push": "1"}[object_])
        return Faults.parse(f"{template.format(m=magnitude, f=force, t=torque)}:from={first}")


def _axes(name: str, value: str, axes: str = "xyz") -> tuple[str, ...]:
    """The fault along each axis: its first parameter is x."""
    return tuple(f"{name}={value}" if axis == "x" else f"{name}=0:{axis}={value}" for axis in axes)


SENSOR_CAUSES: dict[str, SensorCause] = {
    "image.blackout": SensorCause(("blackout={m}",), (0.2, 0.3, 0.6, 0.8)),
    "image.frozen": SensorCause(("image_frozen",), (80, 70, 10, 20), onset=True),
    "image.delay": SensorCause(("delay=image:steps={m}",), (2, 3, 6, 8)),
    "image.shift": SensorCause(("image_shift={m}", "image_shift=0:y={m}", "image_shift=-{m}:y={m}"), (1, 2, 4, 6)),
    "image.noise": SensorCause(("image_noise={m}",), (10, 20, 60, 80)),
    "image.exposure": SensorCause(("image_underexposed={m}",), (0.8, 0.7, 0.4, 0.3)),
    "image.occlusion": SensorCause(("image_occluded={m}",), (5, 6, 14, 12)),
    "force.bias": SensorCause(_axes("force_bias", "{f}"), (0.25, 0.35, 1.5, 2.0)),
    "force.drift": SensorCause(_axes("force_drift", "{f}"), (0.05, 0.07, 0.3, 0.4)),
    "force.gain": SensorCause(("force_gain={m}",), (0.6, 1.7, 0.3, 3.0)),
    "force.sign": SensorCause(("force_gain=-1",), (50, 40, 0, 10), onset=True),
    "force.axes": SensorCause(("force_axes={m}",), ("yxz", "xzy", "zyx", "yzx")),
    "force.noise": SensorCause(("force_noise={f}",), (0.25, 0.35, 1.0, 1.5)),
    "force.stuck": SensorCause(("force_stuck=x", "force_stuck=y", "force_stuck=all"), (60, 50, 10, 20), onset=True),
    "effector.offset": SensorCause(_axes("effector_offset", "{m}", "xy"), (0.005, 0.007, 0.03, 0.04)),
    "contact.stuck": SensorCause(("contact_stuck={contact}",), (50, 40, 0, 10), onset=True),
    "haptics.delay": SensorCause(("delay=haptics:steps={m}",), (2, 3, 6, 8)),
    "control.delay": SensorCause(("control_delay={m}",), (2, 3, 6, 8)),
    "control.scale": SensorCause(("control_scale={m}",), (0.7, 1.4, 0.3, 2.5)),
    "image.blur": SensorCause(("image_blur={m}",), (0.5, 0.7, 2.0, 1.5)),
    "force.saturation": SensorCause(("force_saturation={f}",), (1.0, 0.8, 0.2, 0.15)),
    "torque.bias": SensorCause(_axes("torque_bias", "{t}"), (0.25, 0.35, 1.5, 2.0)),
    "torque.noise": SensorCause(("torque_noise={t}",), (0.25, 0.35, 1.0, 1.5)),
    "effector.noise": SensorCause(("effector_noise={m}",), (0.002, 0.003, 0.01, 0.015)),
    "contact.inverted": SensorCause(("contact_inverted={m}",), (0.1, 0.15, 1.0, 0.5)),
    "contact.delay": SensorCause(("contact_delayed={m}",), (2, 3, 8, 6)),
    "haptics.dropout": SensorCause(("drop=haptics",), (80, 70, 10, 20), onset=True),
}

LABEL_CAUSES: dict[str, tuple[float, ...]] = {
    "labels.delay": (2, 3, 6, 5),  # steps
    "labels.offset": (0.005, 0.007, 0.02, 0.03),  # m, along one of the map components
}
"""Cause -> magnitudes of four levels. The true states that are stored with the episodes are changed."""


def inject(
    cause: str, magnitude: float | str, episodes: Sequence[Episode], seed: int, rng: np.random.Generator
) -> tuple[list[Episode], str, list[int]]:
    """Faulty episodes, the faults as text, and the positions of the affected episodes."""
    faults = SENSOR_CAUSES[cause].faults(episodes[0].task.name, magnitude, rng)
    every = 2 if rng.random() < SOME_EPISODES else 1
    affected = list(range(0, len(episodes), every))
    faulty = [faults.apply(e, seed) if i in affected else e for i, e in enumerate(episodes)]
    return faulty, str(faults), affected


def mislabel(cause: str, magnitude: float, episodes: Sequence[Episode], rng: np.random.Generator) -> list[Episode]:
    """Episodes whose true states are delayed by a number of steps, or offset on the map by a distance, m."""
    if cause == "labels.delay":
        return [replace(e, states=delay_steps(e.states, int(magnitude))) for e in episodes]
    offset = np.zeros(episodes[0].states.shape[1], np.float32)
    offset[int(rng.integers(2))] = magnitude * rng.choice([-1.0, 1.0])  # the first two components are on the map
    return [replace(e, states=e.states + offset) for e in episodes]

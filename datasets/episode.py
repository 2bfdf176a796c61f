"""One recorded trajectory, in NumPy and SI units."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]


@dataclass(frozen=True)
class Episode:
    """One trajectory of T steps; every array's first axis is time.

    Attributes:
        task: name of the task, a key of ``TASKS``.
        states: (T, n) true state, components as in ``Task.components`` (m, rad), float32.
        controls: (T, c) control that led from step t-1 to step t, float32.
        observations: by observation key, (T, ...): what the sensors reported (pictures uint8, else float32).
        contact: (T,) bool, whether the robot truly touched the object.
        qpos: (T, nq) joint positions for the replay, float32; nq is 0 where there is no replay.
        dt: seconds a step.
        seed: seed from which the episode was made, or -1 for recorded data.
        split: ``train``, ``val`` or ``test``.
        provenance: JSON values: how it was made, and what the replay needs (hinge position, policy, versions).
    """

    task: str
    states: FloatArray
    controls: FloatArray
    observations: Mapping[str, NDArray[Any]]
    contact: NDArray[np.bool_]
    qpos: FloatArray
    dt: float
    seed: int
    split: str = "train"
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.states)

    def digest(self) -> str:
        """SHA-256 over the arrays (names, shapes, types and bytes), independent of how they are stored."""
        arrays = {"states": self.states, "controls": self.controls, "contact": self.contact, "qpos": self.qpos}
        arrays |= {f"observations/{key}": value for key, value in self.observations.items()}
        digest = hashlib.sha256(f"{self.task} {self.dt} {self.seed} {self.split}".encode())
        for name in sorted(arrays):
            array = np.ascontiguousarray(arrays[name])
            digest.update(f"{name} {array.shape} {array.dtype.str}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

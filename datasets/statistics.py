"""What a set of episodes is like, beside what the paper's authors recorded of the same task."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task

Statistics = Mapping[str, float | list[float]]
"""Name with its unit -> a number, or one for each of the axes x, y, z. Names are those of ``statistics``."""


@dataclass(frozen=True)
class Recorded:
    """The authors' data of one task.

    Attributes:
        episodes, steps: how many trajectories, and how long the longest is.
        statistics: those that their published code standardises with. Forces and torques have their sensor's axes.
    """

    episodes: int
    steps: int
    statistics: Statistics


AUTHORS = {
    "door": Recorded(
        600,
        800,
        {
            "contact_fraction": 0.63,
            "hinge_x_std_cm": 5.65,
            "hinge_y_std_cm": 5.65,
            "angle_std_deg": 22.6,
            "effector_std_cm": [13.5, 14.9, 4.5],
            "effector_step_std_mm": [3.5, 3.5, 3.5],
            "force_std_N": [36.0, 18.0, 59.0],
            "torque_std_Nm": [1.9, 4.6, 0.65],
        },
    ),
    "push": Recorded(
        1000,
        250,
        {
            "contact_fraction": 0.21,
            "x_std_cm": 5.7,
            "y_std_cm": 6.1,
            "effector_std_cm": [2.4, 2.3, 4.0],
            "force_std_N": [1.6, 1.7, 1.9],
            "torque_std_Nm": [0.14, 0.14, 0.017],
        },
    ),
}


def scale(task_name: str) -> tuple[int, int]:
    """Episodes and steps of a collection where nothing else is asked for: the paper's, or 100 of 200 steps."""
    recorded = AUTHORS.get(task_name)
    return (100, 200) if recorded is None else (recorded.episodes, recorded.steps)


def statistics(task: Task, episodes: Iterable[Episode]) -> Statistics:
    """Spread of the state, and of what haptics there are, over all steps of all episodes.

    Returns:
        ``contact_fraction``, ``<component>_std_<cm or deg>``, ``effector_std_cm``, ``effector_range_cm`` (largest minus
        smallest), ``effector_step_std_mm`` (of its way in one step), ``force_std_N``, ``torque_std_Nm``.
    """
    kept: dict[str, list[NDArray[np.float32]]] = {}
    for episode in episodes:
        seen = episode.observations
        rows = {"contact": episode.contact[:, None].astype(np.float32), "states": episode.states}
        rows |= {key: seen[key] for key in ("effector_position", "force", "torque") if key in seen}
        if "effector_position" in seen:
            rows["way"] = np.diff(seen["effector_position"], axis=0)
        for key, values in rows.items():
            kept.setdefault(key, []).append(values)
    joined = {key: np.concatenate(values).astype(np.float64) for key, values in kept.items()}
    found: dict[str, float | list[float]] = {"contact_fraction": float(joined["contact"].mean())}
    for component, spread in zip(task.components, joined["states"].std(axis=0), strict=True):
        unit, factor = ("cm", 100.0) if component.unit == "m" else ("deg", np.degrees(1.0))
        found[f"{component.name}_std_{unit}"] = float(factor * spread)
    if "way" in joined:
        position = joined["effector_position"]
        found["effector_std_cm"] = (100.0 * position.std(axis=0)).tolist()
        found["effector_range_cm"] = (100.0 * np.ptp(position, axis=0)).tolist()
        found["effector_step_std_mm"] = (1000.0 * joined["way"].std(axis=0)).tolist()
    for key, unit in (("force", "N"), ("torque", "Nm")):
        if key in joined:
            found[f"{key}_std_{unit}"] = joined[key].std(axis=0).tolist()
    return found

"""Statistics of a dataset and the published statistics of the paper's data."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task

Statistics = Mapping[str, float | list[float]]
"""Name with unit -> number, or one number for each of the axes x, y, z. For the names see ``statistics``."""

NAME = re.compile(r"(.+)_(std|range)_(.*)")
"""Quantity, measure and unit of a name."""

QUANTITIES = {
    "contact_fraction": "steps in contact",
    "effector": "effector position",
    "effector_step": "effector displacement per step",
}
MEASURES = {"std": "standard deviation"}
UNITS = {"Nm": "N m"}


def component_ranges(episodes: Sequence[Episode]) -> dict[str, dict[str, Any]]:
    """Unit, smallest and largest finite value of each state component, which show wrong units."""
    states = np.concatenate([episode.states for episode in episodes])
    return {
        component.name: {"unit": component.unit, "min": float(finite.min()) + 0.0, "max": float(finite.max()) + 0.0}
        for component, values in zip(episodes[0].task.components, states.T, strict=True)
        if len(finite := values[np.isfinite(values)])
    }


@dataclass(frozen=True)
class ReferenceData:
    """Published data of a task.

    Attributes:
        episodes: number of episodes. steps: length of the longest one.
        statistics: values used for standardisation in the published code. Forces and torques have sensor axes.
    """

    episodes: int
    steps: int
    statistics: Statistics


PAPER_DATA = {
    "door": ReferenceData(
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
    "push": ReferenceData(
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


def default_size(task_name: str) -> tuple[int, int]:
    """Default number of episodes and steps of a collection: those of the paper, else 100 and 200."""
    reference = PAPER_DATA.get(task_name)
    return (100, 200) if reference is None else (reference.episodes, reference.steps)


def comparison_table(ours: Statistics, reference: Statistics) -> tuple[list[str], list[list[str | float | None]]]:
    """Headings and rows of a table: a row for each number, with that of the reference if it has any."""
    rows: list[list[str | float | None]] = []
    for name, value in ours.items():
        match = NAME.fullmatch(name)
        subject, measure, unit = match.groups() if match else (name, "share", "")
        other = reference.get(name)
        for i, axis in enumerate("xyz" if isinstance(value, list) else [""]):
            number = value[i] if isinstance(value, list) else value
            paper = other[i] if isinstance(other, list) else other
            ratio = None if paper is None else number / paper
            label = f"{QUANTITIES.get(subject, subject.replace('_', ' '))} {axis}".rstrip()
            rows.append([label, MEASURES.get(measure, measure), UNITS.get(unit, unit), number, paper, ratio])
    columns = ["quantity", "measure", "unit", "this data set", "paper", "this / paper"]
    count = len(columns) if reference else columns.index("paper")
    return columns[:count], [row[:count] for row in rows]


def statistics(task: Task, episodes: Iterable[Episode]) -> Statistics:
    """Standard deviations of the state and of the available haptic observations over all steps of all episodes.

    Returns:
        ``contact_fraction``, ``<component>_std_<cm or deg>``, ``effector_std_cm``, ``effector_range_cm`` (maximum minus
        minimum), ``effector_step_std_mm`` (of the displacement per step), ``force_std_N``, ``torque_std_Nm``.
    """
    columns: dict[str, list[NDArray[np.float32]]] = {}
    for episode in episodes:
        observations = episode.observations
        rows = {"contact": episode.contact[:, None].astype(np.float32), "states": episode.states}
        rows |= {key: observations[key] for key in ("effector_position", "force", "torque") if key in observations}
        if "effector_position" in observations:
            rows["displacement"] = np.diff(observations["effector_position"], axis=0)
        for key, values in rows.items():
            columns.setdefault(key, []).append(values)
    joined = {key: np.concatenate(values).astype(np.float64) for key, values in columns.items()}
    result: dict[str, float | list[float]] = {"contact_fraction": float(joined["contact"].mean())}
    for component, spread in zip(task.components, joined["states"].std(axis=0), strict=True):
        unit, factor = component.conversion
        result[f"{component.name}_std_{unit}"] = float(factor * spread)
    if "displacement" in joined:
        position = joined["effector_position"]
        result["effector_std_cm"] = (100.0 * position.std(axis=0)).tolist()
        result["effector_range_cm"] = (100.0 * np.ptp(position, axis=0)).tolist()
        result["effector_step_std_mm"] = (1000.0 * joined["displacement"].std(axis=0)).tolist()
    for key, unit in (("force", "N"), ("torque", "Nm")):
        if key in joined:
            result[f"{key}_std_{unit}"] = joined[key].std(axis=0).tolist()
    return result

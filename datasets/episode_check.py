"""Checks of an episode against its task, by which readers refuse files and writers refuse episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.dataset import SPLITS, EpisodeList
from beliefscope.datasets.episode import Episode, time_error
from beliefscope.datasets.errors import BadInput


def array_error(array: NDArray[Any], shape: tuple[int | None, ...], kind: type, unknown: bool = False) -> str:
    """Why an array is invalid, such as ``is nan at step 3, expected finite numbers``; empty if it is valid.

    Args:
        shape: expected one; None for any length.
        kind: expected type of its elements.
        unknown: whether values may be NaN.
    """
    fits = np.ndim(array) == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits:
        expected = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        return f"has shape {np.shape(array)}, expected {expected}"
    if array.dtype != kind:
        return f"is {array.dtype}, expected {np.dtype(kind)}"
    invalid = np.isinf(array) if unknown else ~np.isfinite(array)
    if invalid.any():
        at = tuple(np.argwhere(invalid)[0])
        return f"is {array[at]} at step {at[0]}, expected finite numbers"
    return ""


def check_episode(episode: Episode, name: str, absent: str = "") -> None:
    """Refuse an episode that could not be read from a file. Raises BadInput that names the array and the step.

    Args:
        name: of the episode, for the error.
        absent: end of the error about a reading that is NaN.
    """
    task, steps = episode.task, len(episode)
    if steps < 1:
        raise BadInput(f"'states' of {name} has shape {episode.states.shape}, expected at least one step.")
    if episode.split not in SPLITS:
        raise BadInput(f"'split' of {name} is {episode.split!r}. Available: {', '.join(SPLITS)}.")
    if not math.isclose(episode.dt, task.dt) and episode.dt != episode.provenance.get("recorded_dt"):
        raise BadInput(f"'dt' of {name} is {episode.dt} s; task {task.name!r} has steps of {task.dt} s.")
    expected: dict[str, tuple[tuple[int | None, ...], type]] = {
        "states": ((steps, len(task.components)), np.float32),
        "controls": ((steps, task.control_size), np.float32),
        "contact": ((steps,), np.bool_),
        "qpos": ((steps, None), np.float32),
    }
    expected |= {f"observations/{k}": ((steps, *shape), task.dtype(k)) for k, shape in task.observations.items()}
    arrays = episode.arrays
    covariates = {f"covariates/{key}" for key in task.covariates} & arrays.keys()
    expected |= dict.fromkeys(sorted(covariates), ((steps,), np.float32))
    if missing := [key for key in expected if key not in arrays]:
        raise BadInput(f"{name} has no {missing[0]!r}. It has: {', '.join(sorted(arrays))}.")
    if undeclared := [key for key in arrays if key not in expected and key != "time"]:
        available = ", ".join(key for key in expected if "/" in key) or "none"
        raise BadInput(
            f"{name} has {undeclared[0]!r}, which task {task.name!r} does not declare. Available: {available}."
        )
    for key, (shape, kind) in expected.items():
        if error := array_error(arrays[key], shape, kind, unknown=key in covariates):
            hint = absent if key.startswith("observations/") and " nan " in error else ""
            raise BadInput(f"{key!r} of {name} {error}{hint}.")
    if episode.time is None:
        return
    if error := array_error(episode.time, (steps,), np.float64) or time_error(episode.time):
        raise BadInput(f"'time' of {name} {error}.")


def checked_list(episodes: Sequence[Episode]) -> EpisodeList:
    """Episodes in memory. Raises BadInput as ``check_episode``, and if there is none or their tasks differ."""
    for index, episode in enumerate(episodes):
        check_episode(episode, f"episode {index}", "; an absent reading repeats the last one and needs a mask")
    return EpisodeList(episodes)

"""Covariates of the steps of runs: everything by which errors may differ, from observations, truth and provenance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.episode import is_image
from beliefscope.datasets.task import Task, display_name, display_unit
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array, Mask
from beliefscope.inspect.trace import Trace

IGNORED = frozenset({"beliefscope", "mujoco", "spawn_index", "start_offset"})
"""Keys of the provenance that do not describe the episode, or that another covariate contains."""

MAX_CATEGORIES = 12
"""Texts with more different values are names rather than categories."""


@dataclass(frozen=True)
class StepCovariate:
    """A quantity of each of S steps.

    Attributes:
        name: display name. unit: for display, may be empty.
        values: (S,) numbers, or indices in ``categories``; NaN where it does not exist.
        categories: names of the values; empty for a number. A boolean has the categories ``no`` and ``yes``.
    """

    name: str
    unit: str
    values: Array
    categories: tuple[str, ...] = ()


@dataclass(frozen=True)
class EpisodeCovariates:
    """Covariates of one trace.

    Attributes:
        index: of the episode. counted: (T,) steps that metrics use.
        columns: name -> unit for display, values (T',) at the counted steps.
    """

    index: int
    counted: Mask
    columns: Mapping[str, tuple[str, NDArray[Any]]]

    @classmethod
    def from_trace(cls, trace: Trace) -> EpisodeCovariates:
        return cls(trace.episode_index, measures.counted(trace), dict(_columns(trace)))


def covariates_of(traces: Sequence[Trace]) -> list[StepCovariate]:
    """Covariates of the concatenated counted steps of traces of one task, without constant ones."""
    return join_covariates([EpisodeCovariates.from_trace(trace) for trace in traces])


def join_covariates(episodes: Sequence[EpisodeCovariates]) -> list[StepCovariate]:
    """As ``covariates_of``."""
    columns = [episode.columns for episode in episodes]
    names = dict.fromkeys(name for column in columns for name in column)
    lengths = [int(episode.counted.sum()) for episode in episodes]
    result = []
    for name in names:
        parts = [column.get(name, ("", np.full(n, np.nan))) for column, n in zip(columns, lengths, strict=True)]
        unit = next(unit for unit, _ in (column[name] for column in columns if name in column))
        covariate = _covariate(name, unit, np.concatenate([values for _, values in parts]))
        if covariate is not None:
            result.append(covariate)
    return result


def _covariate(name: str, unit: str, values: NDArray[Any]) -> StepCovariate | None:
    """None if all values are equal or are names. Texts and booleans become categories."""
    if values.dtype == object or values.dtype.kind in "US":
        texts = np.array([value if isinstance(value, str) else "" for value in values.tolist()])
        categories = tuple(sorted(set(texts.tolist()) - {""}))
        index = np.where(texts == "", np.nan, np.searchsorted(categories, texts)) if categories else np.zeros(0)
        return StepCovariate(name, unit, index, categories) if 1 < len(categories) <= MAX_CATEGORIES else None
    numbers = values.astype(np.float64)
    finite = numbers[np.isfinite(numbers)]
    if not len(finite) or (finite.min() == finite.max() and len(finite) == len(numbers)):
        return None
    return StepCovariate(name, unit, numbers, ("no", "yes") if values.dtype == bool else ())


def _columns(trace: Trace) -> Iterator[tuple[str, tuple[str, NDArray[Any]]]]:
    """Name, unit and values (T',) of each covariate at the counted steps of a trace."""
    counted, task = measures.counted(trace), trace.task
    for name, (unit, factor), values in _step_columns(trace, task):
        yield name, (unit, values[counted] if factor == 1.0 else factor * values[counted])
    definition = TASKS.get(task.name, task)  # data files have no units
    units = {
        _name("ingredients", ingredient, parameter): unit
        for ingredient, drawn in definition.ingredients.items()
        for parameter, unit in drawn.units.items()
    }
    for name, value in _provenance(trace.episode.provenance):
        unit, factor = _conversion(units.get(name, ""))
        yield name, (unit, np.full(int(counted.sum()), value if factor == 1.0 else factor * value))


def _conversion(unit: str) -> tuple[str, float]:
    """Unit for display, also of a rate, and the factor from the SI unit."""
    base, per, rest = unit.partition("/")
    displayed, factor = display_unit(base)
    return displayed + per + rest, factor


def _step_columns(trace: Trace, task: Task) -> Iterator[tuple[str, tuple[str, float], NDArray[Any]]]:
    """Name, unit for display with its factor, and SI values (T,) of the covariates that vary within an episode."""
    second, no_unit = ("s", 1.0), ("", 1.0)
    episode, times, durations = trace.episode, trace.episode.times, trace.episode.durations
    contact, outage = episode.contact.astype(bool), measures.blackout(trace)
    yield "time since start", second, times
    if "contact" in task.covariates:
        yield "contact", no_unit, contact
        yield "contact duration", second, _duration(contact, durations)
    for name, covariate in task.covariates.items():
        values = episode.group_values(name)
        if name != "contact" and covariate.kind == "continuous":
            yield display_name(name), (covariate.unit, 1.0), values  # as in the names of its groups
        elif name != "contact":
            groups = np.array([*covariate.group_names(name), ""], dtype=object)  # the last one: unknown
            yield display_name(name), no_unit, groups[covariate.group_index(values)]
    yield "blackout", no_unit, outage
    yield "outage length", second, _duration(outage, durations)
    change = task.difference(episode.states, np.concatenate([episode.states[:1], episode.states[:-1]]))
    main = task.main_error
    if main.name == "position":
        yield "object speed", (f"{main.unit}/s", main.factor), main.norm(change) / durations
    for i, component in enumerate(task.components):
        unit, factor = component.conversion
        yield f"true {component.label}", (unit, factor), episode.states[:, i]
        if component.unit == "rad":
            yield f"{component.label} speed", (f"{unit}/s", factor), np.abs(change[:, i]) / durations
    for key, array in episode.observations.items():
        known = np.maximum.accumulate(episode.present(key))  # there is no reading before the first one
        for name, values in _reading_columns(array):
            yield f"{display_name(key)} {name}", no_unit, np.where(known, values, np.nan)
    yield "control magnitude", no_unit, np.linalg.norm(episode.controls, axis=1)


def _reading_columns(array: NDArray[Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Name and values (T,) of the covariates of a sensor's readings (T, ...)."""
    if is_image(array):
        pixels = array.reshape(len(array), -1)
        yield "brightness", pixels.mean(1)
        yield "contrast", pixels.std(1)
    elif array.ndim == 2 and array.shape[1] > 1:
        yield "magnitude", np.linalg.norm(array, axis=1)
        yield "change", np.linalg.norm(np.diff(array, axis=0, prepend=array[:1]), axis=1)


def _duration(mask: Mask, durations: Array) -> Array:
    """(T,) s since the mask (T,) was last False, for steps of these durations (T,); NaN where it is False."""
    times = np.cumsum(durations)
    return np.where(mask, times - np.maximum.accumulate(np.where(mask, 0.0, times)), np.nan)


def _name(*keys: str) -> str:
    """Display name of a value of the provenance, from the keys of its nested mappings."""
    return " ".join(map(display_name, keys)).strip().replace("ingredients ", "").replace("-", " ")


def _provenance(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Display name and value of each number, boolean and text of the provenance, nested ones included."""
    for key, value in values.items():
        name = _name(prefix, key)
        if key in IGNORED:
            continue
        if isinstance(value, Mapping):
            yield from _provenance(value, name)
        elif isinstance(value, list | tuple):
            yield f"number of {name}", float(len(value))
        elif isinstance(value, bool | int | float | str):
            yield name, value if isinstance(value, bool | str) else float(value)

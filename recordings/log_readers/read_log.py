"""Episodes and traces from the columns of a log."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.covariate import CONTACT, Covariate
from beliefscope.datasets.episode import Episode, hold, time_error
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task, display_name
from beliefscope.datasets.task_json import check_definition
from beliefscope.datasets.text import plural
from beliefscope.filters.external.adapter import check_values
from beliefscope.filters.external.derived_values import derived
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.external import fill_missing
from beliefscope.recordings.log_readers.arrays import Columns
from beliefscope.recordings.log_readers.column_map import TIME_UNITS, ColumnMap, CovariateColumn, base_name, listed
from beliefscope.recordings.log_readers.columns import column, joined
from beliefscope.recordings.log_readers.estimate import estimate_values, scalar
from beliefscope.recordings.log_readers.innovations import innovation_values
from beliefscope.recordings.log_readers.messages import CLOCK, NEW
from beliefscope.recordings.log_readers.table_folder import FILE

Array = NDArray[np.float64]

IRREGULAR = 0.01  # deviation of a time from a constant step, relative to the step, above which the times are kept

LARGE, SMALL = 5.0, 0.05  # m, span of the positions above which they are displayed in m, and below which in mm

AUTO = {8: "val", 9: "test"}
"""Last digit of an episode's number -> its split; the others are for training."""

MARGIN = 1.2  # half width of maps relative to the largest half range of the map components


def read_log(columns: Columns, mapping: ColumnMap, source: str, split: str = "test") -> list[Episode]:
    """The episodes of a log, in the order of their first rows.

    split: of all episodes, ``train``, ``val`` or ``test``; ``auto`` as for collected ones, ``AUTO``.

    Raises BadInput for missing columns, columns of different lengths and times that do not ascend, and for ``auto``
    with less than ten episodes.
    """
    states = _float32(_states(columns, mapping), "the state")
    sensors = {name: _in_units(mapping, name, _sensor(columns, name, refs)) for name, refs in mapping.sensors.items()}
    control = joined(columns, mapping.control, "control") if mapping.control else np.zeros((len(states), 0))
    controls = _float32(control, "the control")
    contact = column(columns, mapping.contact, "contact") if mapping.contact else np.zeros(len(states))
    _check_rows(contact, f"contact, column {mapping.contact!r},", len(states))
    covariates = {name: _covariate(columns, name, entry) for name, entry in mapping.covariates.items()}
    values = {name: numbers for name, (_, numbers) in covariates.items()}
    arrays: dict[str, NDArray[Any]] = {"state": states, "control": controls, "contact": contact, **sensors, **values}
    for name, array in arrays.items():
        if len(array) != len(states):
            raise BadInput(f"{name} has {plural(len(array), 'row')} and the state {len(states)}")
    rows = _episodes(columns, mapping, len(states))
    if max(map(len, rows.values())) < 2:
        step = f" of {mapping.dt:g} s" if mapping.dt else ""
        raise BadInput(f"{source} has one step{step} per episode, expected two or more")
    if split == "auto" and len(rows) < 10:
        raise BadInput(f"{source} has {plural(len(rows), 'episode')}; --split auto needs 10: give train, val or test")
    dt, times = _times(columns, mapping, rows)
    declared = {name: covariate for name, (covariate, _) in covariates.items()}
    present = {name: _present(columns, mapping, name, array) for name, array in sensors.items()}
    masks = {name: f"{name} reading" for name, mask in present.items() if not mask.all()}
    declared |= {name: Covariate("boolean") for name in masks.values()}
    values |= {masks[name]: present[name].astype(np.float32) for name in masks}
    regular = {name: array for name, array in sensors.items() if name not in masks}
    periods = {name: period for name, array in regular.items() if (period := _period(array, rows, dt))}
    task = _task(mapping, states, sensors, controls.shape[1], dt, declared, periods, masks)
    return [
        Episode(
            task=task,
            states=states[at],
            controls=controls[at],
            observations={name: hold(array[at], present[name][at]) for name, array in sensors.items()},
            contact=contact[at] != 0.0,
            qpos=np.zeros((len(at), 0), np.float32),
            dt=dt,
            seed=-1,
            split=AUTO.get(index % 10, "train") if split == "auto" else split,
            provenance={"source": source, "episode": name},
            covariates={name: numbers[at] for name, numbers in values.items()},
            time=time,
        )
        for index, ((name, at), time) in enumerate(zip(rows.items(), times, strict=True))
    ]


def check_complete(episodes: list[Episode]) -> None:
    """Raise BadInput for episodes with unknown values, which a data set cannot have."""
    for index, episode in enumerate(episodes):
        arrays = {c.name: episode.states[:, i] for i, c in enumerate(episode.task.components)}
        for name, array in (arrays | {"control": episode.controls} | dict(episode.observations)).items():
            if (unknown := np.isnan(array)).any():
                row = int(np.argwhere(unknown)[0][0])
                where = f"episode {index}, step {row}" if row else f"episode {index}"
                raise BadInput(
                    f"{name} is unknown in {where}: a data set needs all states, controls and readings; "
                    "interpolate short gaps, or write a trace, in which true states may be missing"
                )


def recorded_trace(columns: Columns, mapping: ColumnMap, episodes: list[Episode], index: int, source: str) -> Trace:
    """The recorded estimate of an episode as a trace, float32.

    Raises BadInput for a map without an estimate, and for values of the wrong shape or that are not finite.
    """
    if not {"mean", "particles"} & set(mapping.estimate):
        raise BadInput("the map has no estimate: add [estimate] with mean or particles, or write a data set (.h5)")
    rows, n, episode = sum(map(len, episodes)), len(mapping.components), episodes[index]
    at = list(_episodes(columns, mapping, rows).values())[index]
    estimate = estimate_values(columns, mapping)
    for name, array in estimate.items():
        if len(array) != rows:
            raise BadInput(f"{display_name(name)} has {plural(len(array), 'row')} and the state {rows}")
        if len(unknown := at[~np.isfinite(array[at]).reshape(len(at), -1).all(axis=1)]):
            where = f"row {unknown[0]}, episode {index}"
            raise BadInput(f"{display_name(name)} has no finite value in {where}: interpolate or remove such rows")
    modalities = tuple(mapping.estimate.get("weights", {}) or mapping.innovations)
    estimate |= innovation_values(columns, mapping, modalities)
    values = {name: torch.from_numpy(array[at]) for name, array in estimate.items()}
    check_values(values, (len(at),), {"n": n}, source)
    arrays: dict[str, Any] = {name: value.float().numpy() for name, value in derived(values, episode.task).items()}
    settings = {"source": source} | ({"particles": arrays["particles"].shape[1]} if "particles" in arrays else {})
    return Trace(
        episode=episode,
        modalities=modalities,
        kind="external",
        filter=str(mapping.estimate.get("filter", "recorded")),
        start_mean=np.full(n, np.nan, np.float32),
        start_covariance=np.full((n, n), np.nan, np.float32),
        data_hash=episode.digest(),
        episode_index=index,
        settings=settings,
        **dict[str, Any](fill_missing(arrays, len(modalities))),
    )


def _states(columns: Columns, mapping: ColumnMap) -> Array:
    """(T, n) true states, SI units; NaN where they are unknown."""
    states = {name: scalar(columns, s.column, s.unit, f"state {name}") for name, s in mapping.state.items() if s.column}
    count = len(next(iter((states or columns).values())))
    for name, part in states.items():
        if part.shape != (expected := (count, mapping.state[name].size)):
            reference = mapping.state[name].column
            raise BadInput(
                f"state {name!r} has column {reference!r} of shape {part.shape}, expected {expected}: a row is a step, "
                "NAME[0] the first number of a row, and `episode` a column that numbers the episodes"
            )
    parts = [states.get(name, np.full((count, entry.size), np.nan)) for name, entry in mapping.state.items()]
    return np.concatenate(parts, axis=1) * mapping.factors


def _sensor(columns: Columns, name: str, references: str | list[str]) -> NDArray[Any]:
    """Images (T, H, W) or (T, H, W, 3) uint8; or (T, d) vectors and arrays of other shapes, float32."""
    if not isinstance(references, str) or references not in columns or columns[references].ndim < 3:
        return _float32(joined(columns, references, f"sensor {name}"), f"sensor {name!r}")
    values = columns[references]
    is_colour = values.ndim == 4 and values.shape[3] == 3
    if values.dtype == np.uint8 and (values.ndim == 3 or is_colour):
        return values
    if is_colour and values.dtype.kind in "fiu" and values.min() >= 0 and 1 < values.max() <= 255:
        images = values.astype(np.uint8)  # colours are often stored as floats
        if np.array_equal(images, values):
            return images
    return _float32(column(columns, references, f"sensor {name}"), f"sensor {name!r}")


def _in_units(mapping: ColumnMap, name: str, readings: NDArray[Any]) -> NDArray[Any]:
    """Readings in internal units. Raises BadInput for a unit of images and arrays, and for too few or many units."""
    if name not in mapping.units:
        return readings
    if readings.ndim != 2:
        raise BadInput(f"sensor {name!r} has a unit and rows of shape {readings.shape[1:]}, expected a list of numbers")
    factors = np.array([factor for _, factor in mapping.internal_units(name, readings.shape[1])])
    return (readings * factors).astype(np.float32)


def _present(columns: Columns, mapping: ColumnMap, name: str, readings: NDArray[Any]) -> NDArray[np.bool_]:
    """(T,): rows with a reading of a sensor: some value is known, ``valid`` is not zero, a topic has a new message."""
    present = np.isfinite(readings).reshape(len(readings), -1).any(axis=1)
    if name in mapping.valid:
        valid = column(columns, mapping.valid[name], f"valid of sensor {name}")
        if valid.shape != present.shape:
            raise BadInput(f"valid of sensor {name!r} has shape {valid.shape}, expected {present.shape}")
        present &= np.nan_to_num(valid) != 0.0
    messages = [columns[new] for ref in listed(mapping.sensors[name]) if (new := NEW + base_name(ref)) in columns]
    return present & np.any(messages, axis=0) if messages else present


def _float32(values: Array, name: str) -> NDArray[np.float32]:
    """The values in single precision. Raises BadInput for infinite ones and those beyond its range."""
    with np.errstate(over="ignore"):
        single = values.astype(np.float32)
    if (infinite := np.isinf(single)).any():
        row = int(np.argwhere(infinite)[0][0])
        raise BadInput(f"{name} has the value {values[infinite][0]:g} in row {row}, expected a finite number")
    return single


def _episodes(columns: Columns, mapping: ColumnMap, count: int) -> dict[str, NDArray[np.intp]]:
    """Name of each episode -> its rows."""
    name = mapping.episode or (FILE if FILE in columns else "")
    if not name:
        return {"0": np.arange(count)}
    if name not in columns:
        column(columns, name, "episode")  # raises the error with similar names
    numbers = columns[name]
    _check_rows(numbers, f"the episode, column {name!r},", count)
    if numbers.dtype.kind == "f" and len(unknown := np.flatnonzero(np.isnan(numbers))):
        raise BadInput(f"the episode, column {name!r}, has no value in row {unknown[0]}")
    names, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
    return {str(names[i]): np.flatnonzero(inverse == i) for i in np.argsort(first)}


def _check_rows(values: NDArray[Any], what: str, count: int) -> None:
    """Raise BadInput unless there is one value per row."""
    if values.shape != (count,):
        raise BadInput(f"{what} has the shape {values.shape}, expected one value in each of {count} rows")


def _times(columns: Columns, mapping: ColumnMap, rows: dict[str, NDArray[np.intp]]) -> tuple[float, list[Array | None]]:
    """s per row, and each episode's times (T,), s since its first row; None for steps of this length.

    Raises BadInput for times that do not ascend within an episode.
    """
    if mapping.dt is not None:
        return float(mapping.dt), [None] * len(rows)
    name = CLOCK if mapping.clock else mapping.time
    column_times = column(columns, name, "time") * TIME_UNITS[mapping.time_unit]
    _check_rows(column_times, f"time {name!r}", sum(map(len, rows.values())))
    times = [column_times[at] - column_times[at[0]] for at in rows.values()]
    for episode, time in zip(rows, times, strict=True):
        if error := time_error(time):
            hint = "; remove rows with repeated times, or give dt in its place" if (np.diff(time) == 0.0).any() else ""
            raise BadInput(f"time {name!r} of episode {episode} {error}, counted from its first row{hint}")
    dt = float(f"{np.median(np.concatenate([np.diff(time) for time in times])):.9g}")  # rounding errors
    resolution = np.spacing(np.abs(column_times).max())  # of times since 1970: 0.2 us
    dt = round(dt, int(-np.log10(resolution))) if resolution < IRREGULAR * dt else dt
    regular = [np.abs(time - dt * np.arange(len(time))).max() <= IRREGULAR * dt for time in times]
    return dt, [None if same else time for same, time in zip(regular, times, strict=True)]


def _period(readings: NDArray[Any], rows: dict[str, NDArray[np.intp]], dt: float) -> float:
    """s between the readings of a sensor that is slower than the steps: the median between changes; 0 for others."""
    gaps = [
        np.diff(np.flatnonzero((np.diff(readings[at], axis=0) != 0).reshape(len(at) - 1, -1).any(1)))
        for at in rows.values()
        if len(at) > 1
    ]
    between = np.concatenate([*gaps, np.zeros(0)])
    steps = float(np.median(between)) if len(between) else 0.0
    return steps * dt if steps > 1.0 else 0.0


def _covariate(columns: Columns, name: str, entry: CovariateColumn) -> tuple[Covariate, NDArray[np.float32]]:
    """A covariate and its values (T,): categories are numbered in alphabetical order, empty texts are unknown."""
    if entry.column in columns and columns[entry.column].dtype.kind in "US":
        texts = columns[entry.column]
        groups = np.unique(texts[texts != ""])
        values = np.where(texts == "", np.nan, np.searchsorted(groups, texts)).astype(np.float32)
        return Covariate("categorical", tuple(map(str, groups))), values
    numbers = column(columns, entry.column, f"covariate {name}")
    if numbers.ndim != 1:
        raise BadInput(f"covariate {name!r} has column {entry.column!r} of shape {numbers.shape}, expected one number")
    boolean = not entry.cuts and np.isin(numbers[~np.isnan(numbers)], (0.0, 1.0)).all()
    covariate = Covariate("boolean") if boolean else Covariate("continuous", cuts=entry.cuts, unit=entry.unit)
    return covariate, _float32(numbers, f"covariate {name!r}")


def _task(
    mapping: ColumnMap,
    states: NDArray[np.float32],
    sensors: dict[str, NDArray[Any]],
    controls: int,
    dt: float,
    covariates: dict[str, Covariate],
    periods: dict[str, float],
    masks: dict[str, str],
) -> Task:
    units = [component.unit for component in mapping.components]
    spans = np.ptp(np.nan_to_num(states), axis=0)
    span = max((span for span, unit in zip(spans, units, strict=True) if unit == "m"), default=0.0)
    display = ("m", 1.0) if span > LARGE else ("mm", 1e3) if 0.0 < span < SMALL else None
    components = tuple(
        replace(
            component,
            display=display if component.unit == "m" and display else component.display,
            wraps=bool(span > np.pi) and component.unit == "rad" and not component.rotation,
        )
        for component, span in zip(mapping.components, spans, strict=True)
    )
    extent = max(span for span, unit in zip(spans[:2], units, strict=False) if unit == units[0]) / 2.0
    sizes = {"control": controls} | {name: array.shape[1] for name, array in sensors.items() if array.ndim == 2}
    task = Task(
        name=mapping.task,
        components=components,
        channels=mapping.channels(sizes),
        observations={name: array.shape[1:] for name, array in sensors.items()},
        modalities=mapping.modalities,
        control_size=controls,
        dt=dt,
        map_components=tuple(component.name for component in components[:2]),
        map_half_width=float(MARGIN * max(extent, 0.01)),
        warmup=0,
        periods=periods,
        masks=masks,
        covariates=({"contact": CONTACT} if mapping.contact else {}) | covariates,
        arrays=tuple(name for name, array in sensors.items() if array.ndim > 2 and array.dtype != np.uint8),
    )
    check_definition(task, f"task {mapping.task!r}")
    return task

"""First map of a log, from the names and shapes of its columns; what is unclear is left to the user."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.recordings.log_readers.arrays import Columns
from beliefscope.recordings.log_readers.column_map import PLANAR_ELEMENTS, QUATERNION, TIME_UNITS, base_name, marked
from beliefscope.recordings.log_readers.columns import column as column_values
from beliefscope.recordings.log_readers.messages import Preview
from beliefscope.recordings.log_readers.table_folder import FILE

TRUTH = r"truth|true|gt|ground|state|mocap|vicon|optitrack"
ESTIMATE = r"(?<![a-z])est|mean|pred|filter|posterior|belief|_hat\b"
STD = r"std|sigma|\u03c3|(^|_)sd(_|$)"  # \u03c3 is the letter sigma
SHORT_STD = r"(?:s|sd|std|std_?dev|sigma|\u03c3)"
"""Pattern of the part of a name that marks the standard deviation of a component: ``sx``, ``yaw_sigma``."""

FILTERS = r"ekf|ukf|amcl|slam|kalman|(^|[./])[kp]f[._/]"
POSE_ESTIMATES = (rf"{ESTIMATE}|{FILTERS}|local", r"odom")
"""Patterns of the names of estimated poses: of filters before odometry, which may be that of the wheels."""

CONTROL = r"(^|[/_.])(actions?|controls?|cmd|commands?)([/_.]|$)|^u_?\d*$"
INTERNAL = r"innov|residual|(^|[._/])(nis|nees|ess|n_?eff)([._/]|$)|(^|[._/])(P|cov|var)_(?P<axis>[a-z])(?P=axis)$"
"""Pattern of values within a filter, which are neither estimates nor readings, such as the variance ``P_xx``."""

VARIANCE = r"(^|[./])(P|cov|covariance)[_.\[(]?(\d|[xyz]_?[xyz]$)"
"""Pattern of the elements of a covariance in columns of their own."""

ROW_AND_COLUMN = re.compile(r"(\d|[xyz])[_,.]?(\d|[xyz])[\])]?$", re.I)
"""Row and column of such an element, at the end of its name."""

TRUTH_AFFIX = re.compile(r"^(ground_?truth|truth|true|gt|state|mocap|vicon|optitrack)[_./]|_(true|truth|gt)$", re.I)
"""Part of a column's name that marks a true value."""

ESTIMATE_AFFIX = re.compile(
    r"^(est|estimated?|mean|pred|predicted|filter|filtered|posterior|belief|ekf|ukf|kf|pf)[_./ ]+"
    r"|[_./ ](est|estimated?|mean|pred|filtered|posterior|hat)$",
    re.I,
)
"""Part of a column's name that marks an estimate."""

TIME = re.compile(r"(?:t|time|time_?stamp|stamp)(?:[_ ]*[\[(]?(s|ms|us|ns)[\])]?)?", re.I)
"""Name of a column of times, with their unit."""

EPOCHS = {"ns": 1e17, "us": 1e14, "ms": 1e11}
"""Unit -> least value of times since 1970 in it."""

UNITS_BY_NAME = {
    "rad/s": r"^w[xyz]?$|omega|yaw_?rate|gyro|angular",
    "m/s^2": r"^a[xyz]$|acc",
    "m/s": r"^v[xyz]?$|(^|_)v(el|x|y|z)?(_|$)|velocity|speed",
    "rad": r"yaw|heading|theta|roll|pitch|angle",
}
"""Unit of a component -> pattern of its name; the first that matches."""

CHANNEL = re.compile(r"(.+?)[_.]?(x|y|z|lat|lon|alt|east|north|up|\d+)$", re.I)
"""Name of a sensor and of one of its channels."""

ANGLES = ("deg", "rad")

CLOSE = 0.5
"""Largest root mean square difference of readings and true state, in standard deviations of the latter."""

DT = 0.1
"""s per step, if the log has no times."""


def guess_map(log: Preview, name: str) -> str:
    """Text of a first map."""
    lines = [f'task = "{re.sub(r"[^A-Za-z0-9_.-]", "-", name)}"']
    lines += [f"time = {_text(log.timeline)}"] if log.timeline else []
    lines += _messages(log.columns, log.intervals) if log.intervals else _table(log.columns)
    return "\n".join(lines) + "\n"


def _table(every: Columns) -> list[str]:
    internal = _named(INTERNAL, [n for n, values in every.items() if values.dtype.kind in "fiub"])
    columns = {n: values for n, values in every.items() if n not in internal}
    flat = [n for n, values in columns.items() if values.ndim == 1 and values.dtype.kind in "fiub"]
    rows = {n: values for n, values in columns.items() if values.ndim > 1}
    time = [n for n in flat if TIME.fullmatch(n)]
    episode = _named(r"^episode(_index|_id)?$", [*columns])
    counters = _named(r"^(frame_|task_)?index$|^__index_level_\d+__$", flat)
    dates = [n for n, values in columns.items() if values.ndim == 1 and values.dtype.kind == "M"]
    time = time or dates[:1]
    elements = _named(VARIANCE, flat)
    mean, state, std = _estimate(flat, rows, elements)
    ensemble = _named(r"ensemble|particle|sample", [n for n in rows if rows[n].ndim == 3])[:1]
    square = [n for n in rows if rows[n].ndim == 3 and rows[n].shape[1] == rows[n].shape[2]]
    covariance = [n for n in square if rows[n].dtype.kind == "f"][:1]
    covariance = covariance or _square(elements, len(mean))
    if not mean and not ensemble:  # of an estimate: without it, they are sensors
        std, covariance = [], []
    # Standard deviations of some components only cannot be imported.
    complete = len(std) == len(mean) or mean[:1] == [name for name in mean if name in rows]
    deviations = std if complete and not covariance else []
    if mean:
        internal += [n for n in (*std, *elements) if n not in {*deviations, *covariance, *mean}]
    control = _named(CONTROL, flat) or _named(CONTROL, [*rows])[:1]
    flags = [n for n in _named(r"contact|touch", flat) if {*np.unique(columns[n]).tolist()} <= {0, 1}][:1]
    used = {*time, *episode, *counters, *state.values(), *mean, *std, *covariance, *ensemble, *control, *flags}
    used |= {n.partition("[")[0] for n in state.values() if n not in columns} | {*internal}
    sensors = _sensors([n for n in columns if n not in used and (n in flat or n in rows)], flat)
    texts = [n for n, values in columns.items() if n not in used and n not in flat and n not in rows and n != FILE]
    lines = [f"time = {_time(time[0], columns[time[0]])}" if time else f"dt = {DT}  # s per row"]
    lines += [f"episode = {_text(episode[0])}"] if episode else []
    lines += [f"control = {_text(control[0]) if len(control) == 1 else _texts(control)}"] if control else []
    lines += [f"contact = {_text(flags[0])}"] if flags else []
    examples = dict(zip(state, mean, strict=False))  # the unit of a component without truth is that of its estimate
    values = {c: _value(c, reference, columns, examples.get(c, "")) for c, reference in state.items()}
    truth = {c: (n, _unit(c, n, columns)[0] or "m") for c, n in state.items() if n in flat}
    lines += _sections(values, {key: _reading(columns, references, truth) for key, references in sensors.items()})
    if mean or ensemble:
        lines.append("[estimate]")
        columns_of = {"mean": mean, "std": deviations, "covariance": covariance, "particles": ensemble}
        lines += [f"{key} = {_text(n[0]) if len(n) == 1 else _texts(n)}" for key, n in columns_of.items() if n]
        if std and not complete:
            lines.append(f"# std needs {len(mean)} columns, one for each of mean; the log has {_texts(std)}")
    lines += _unused(internal)
    return lines + ([f"# not numbers, for time, episode or [covariates]: {_texts(texts)}"] if texts else [])


def _estimate(
    flat: Sequence[str], rows: Columns, elements: Sequence[str]
) -> tuple[list[str], dict[str, str], list[str]]:
    """Columns of the mean, those of the true states by component, and those of the standard deviations.

    Mean and deviations have the order of the components, if their names end alike. Without names of true states, they
    are the columns with the names of the estimate: ``x`` beside ``x_hat``. elements: of the covariance.
    """
    std = _named(STD, flat) or [n for n in _named(STD, [*rows]) if rows[n].ndim == 2][:1]
    patterns = (ESTIMATE, FILTERS)
    mean = next((named for p in patterns if (named := _means(p, flat, rows, {*std, *elements}))), [])
    state = _components(_named(TRUTH, flat), rows, _named(TRUTH, [*rows]))
    names = {_key(ESTIMATE_AFFIX.sub("", marked(n)[0])): n for n in mean if n in flat}
    if not names or len(names) < len(mean):  # arrays, or estimates of several filters
        return mean, state, std
    short = _deviations(names, flat)
    names = {name: n for name, n in names.items() if n not in short.values()}  # ekf_sx is no component
    mean, short = [*names.values()], {name: n for name, n in short.items() if name in names}
    state = state or {key: n for n in flat if n not in mean and (key := _key(marked(n)[0])) in names}
    if names.keys() >= state.keys():  # components without truth have an empty name
        state |= {name: "" for name in names if name not in state}
        mean = [names[name] for name in state]
    std = [short[name] for name in state if name in short] if len(short) >= len(std) else std
    return mean, state, std


def _square(elements: Sequence[str], n: int) -> list[str]:
    """Columns of all n times n elements of a covariance, from those of one triangle as well; none for other numbers."""
    if len(elements) == n * n:
        return [*elements]
    places = [match.groups() for name in elements if (match := ROW_AND_COLUMN.search(name))]
    column_of = {frozenset(place): name for place, name in zip(places, elements, strict=False)}
    axes = [row for row, column in places if row == column]
    is_triangle = len(places) == len(column_of) == n * (n + 1) // 2 and len(axes) == n
    square = [column_of.get(frozenset({i, j}), "") for i in axes for j in axes]
    return square if is_triangle and all(square) else []


def _deviations(components: Iterable[str], flat: Sequence[str]) -> dict[str, str]:
    """Component -> column of its standard deviation."""
    result = {}
    for component in components:
        name = re.escape(component)
        pattern = rf"(^|[._/ ]){SHORT_STD}[_.]?{name}$|(^|[._/ ]){name}[_.]{SHORT_STD}$"
        if column := next((n for n in flat if re.search(pattern, marked(n)[0], re.IGNORECASE)), ""):
            result[component] = column
    return result


def _time(name: str, values: NDArray[Any]) -> str:
    """A column of times, with the unit of its name, or of its values if they are times since 1970."""
    match = TIME.fullmatch(name)
    largest = np.nanmax(values, initial=0.0) if values.dtype.kind in "fiu" else 0.0
    unit = (match[1] or "").lower() if match else ""
    unit = unit or next((each for each, least in EPOCHS.items() if largest > least), "s")
    return _text(name) if TIME_UNITS[unit] == 1.0 else f"{{column = {_text(name)}, unit = {_text(unit)}}}"


def _messages(columns: Columns, intervals: Mapping[str, float]) -> list[str]:
    """State and estimate from poses, or topics of numbers, with such names; the rest are sensors."""
    poses = dict(filter(None, (_pose(columns, name) for name in columns))) | _groups(columns, intervals)
    truth = next(iter(_named(TRUTH, [*poses])), "")
    state = poses.get(truth, {})
    others = [pose for pose in poses if pose != truth and (not truth or poses[pose].keys() == state.keys())]
    estimate = next((name for pattern in POSE_ESTIMATES for name in _named(pattern, others)), "")
    used = [*state.values(), *poses.get(estimate, {}).values()]
    topics = {_topic(intervals, base_name(reference)) for reference in used}
    readings = [n for n in columns if _is_reading(columns, n) and _topic(intervals, n) not in topics]
    internal = _named(INTERNAL, readings)
    every = list(dict.fromkeys(_vector(columns, n) for n in readings if n not in internal))
    control = _named(CONTROL, every)
    references = [reference for reference in every if reference not in control]
    steps = [*poses.get(estimate, state).values()]  # the filter's own, rather than those of the true states
    clock = intervals[_topic(intervals, base_name(steps[0]))] if steps else 0.0
    clock = clock or min((interval for interval in intervals.values() if interval > 0.0), default=DT)
    lines = [f"dt = {clock:.3g}  # s per step of the common clock"]
    lines += [f"control = {_text(control[0]) if len(control) == 1 else _texts(control)}"] if control else []
    values = {_key(component): _component(reference) for component, reference in state.items()}
    lines += _sections(values, {_key(ref.strip("/")): _reading(columns, ref) for ref in references})
    if estimate:
        lines += ["[estimate]", f"mean = {_texts([*poses[estimate].values()])}"]
        covariance = f"{estimate.removesuffix('.pose')}.covariance"
        if covariance in columns and columns[covariance].shape[1:] == (36,):
            lines.append(f"covariance = {_text(covariance + PLANAR_ELEMENTS)}  # of x, y and yaw")
    return lines + _unused(internal)


def _component(reference: str) -> str:
    """A component of the state: its column, or that of a quaternion."""
    is_quaternion = reference.endswith((".orientation", ".quaternion"))
    return f'{{column = {_text(reference)}, unit = "{QUATERNION}"}}' if is_quaternion else _text(reference)


def _pose(columns: Columns, name: str) -> tuple[str, dict[str, str]] | None:
    """Prefix of a pose and its columns of x, y and orientation, if ``name`` is the first column of a pose."""
    if name.endswith(".position.x") and f"{(prefix := name.removesuffix('.position.x'))}.orientation.w" in columns:
        return prefix, {"x": name, "y": f"{prefix}.position.y", "yaw": f"{prefix}.orientation"}  # ROS
    if name.endswith(".translation") and f"{(prefix := name.removesuffix('.translation'))}.quaternion" in columns:
        return prefix, {"x": f"{name}[0]", "y": f"{name}[1]", "yaw": f"{prefix}.quaternion"}  # Rerun
    return None


def _groups(columns: Columns, topics: Mapping[str, float]) -> dict[str, dict[str, str]]:
    """Topics of two numbers or more: field -> column."""
    groups: dict[str, dict[str, str]] = {}
    for name, values in columns.items():
        topic, _, field = name.rpartition(".")
        if topic in topics and values.ndim == 1 and _is_reading(columns, name):
            groups.setdefault(topic, {})[field] = name
    return {topic: group for topic, group in groups.items() if len(group) > 1}


def _is_reading(columns: Columns, name: str) -> bool:
    """Whether a column has numbers that are neither times nor covariances."""
    return columns[name].dtype.kind in "fiub" and not re.search(r"covariance|\b(sec|nanosec|timestamp)$", name)


def _vector(columns: Columns, name: str) -> str:
    """The message of a field if it has only single numbers, else the field."""
    parent = name.rpartition(".")[0]
    fields = [n for n in columns if n.startswith(f"{parent}.")]
    return parent if parent and all(_is_reading(columns, n) and columns[n].ndim == 1 for n in fields) else name


def _value(component: str, reference: str, columns: Columns, example: str) -> str:
    """A component of the state: its column, with its unit if it is not m. example: column of its estimate."""
    unit, comment = _unit(component, reference or example, columns)
    column = _text(reference)
    return f"{{column = {column}, unit = {_text(unit)}}}{comment}" if unit not in ("", "m") else column


def _unit(name: str, reference: str, columns: Columns) -> tuple[str, str]:
    """Unit of a column, which its name or else that of its quantity implies, and a comment if it is uncertain."""
    if unit := marked(reference)[1]:
        return unit, ""
    unit = next((u for u, pattern in UNITS_BY_NAME.items() if re.search(pattern, name, re.I)), "")
    if unit != "rad" or not reference:
        return unit, ""
    values = column_values(columns, reference, name)
    known = values[np.isfinite(values)]
    if np.abs(known).max(initial=0.0) <= 2.0 * np.pi:
        return "rad", ""
    return "deg", f"  # {known.min():.4g} to {known.max():.4g}: check the unit"


def _sensors(names: Sequence[str], flat: Sequence[str]) -> dict[str, str | list[str]]:
    """Sensor -> columns; single numbers such as gps_x and gps_y are the channels of one sensor."""
    groups: dict[str, list[str]] = {}
    for name in names:
        channel = CHANNEL.fullmatch(marked(name)[0]) if name in flat else None
        groups.setdefault(channel[1] if channel else name, []).append(name)
    keys = [_key(group if len(members) > 1 else marked(members[0])[0]) for group, members in groups.items()]
    return {
        key if keys.count(key) == 1 else _key(members[0]): members if len(members) > 1 else members[0]
        for key, members in zip(keys, groups.values(), strict=True)
    }


def _reading(
    columns: Columns, references: str | list[str], truth: Mapping[str, tuple[str, str]] = MappingProxyType({})
) -> str:
    """Columns of a sensor, or fields of a message, with units: those at the ends of their names, and of angles.

    Channels with the names of true states, and values close to them, have their unit. truth: name -> column and unit.
    """
    value = _text(references) if isinstance(references, str) else _texts(references)
    listed = [references] if isinstance(references, str) else references
    names = [n for ref in listed for n in ([ref] if ref in columns else columns) if n == ref or n.startswith(f"{ref}.")]
    marks = [(n, *_unit(n, n, columns)) for n in names if columns[n].ndim == 1 and columns[n].dtype.kind in "fiub"]
    units = [unit if unit in ANGLES or marked(n)[1] else _unit_of_truth(n, columns, truth) for n, unit, _ in marks]
    comment = next((comment for *_, comment in marks if comment), "")
    if not any(units):
        return value
    return f"{{column = {value}, unit = {_text(units[0]) if len({*units}) == 1 else _texts(units)}}}{comment}"


def _unit_of_truth(name: str, columns: Columns, truth: Mapping[str, tuple[str, str]]) -> str:
    """Unit of the true state that a channel such as gps_x measures; empty for readings that are not close to it."""
    channel = CHANNEL.fullmatch(name)
    state, unit = truth.get(channel[2] if channel else "", ("", ""))
    if not state:
        return ""
    values, expected = columns[name].astype(np.float64), columns[state].astype(np.float64)
    if not (known := np.isfinite(values) & np.isfinite(expected)).any():
        return ""
    values, expected = values[known], expected[known]
    return unit if np.sqrt(np.mean((values - expected) ** 2)) < CLOSE * expected.std() else ""


def _unused(internal: Sequence[str]) -> list[str]:
    return [f"# of the filter, neither sensors nor estimates: {_texts(internal)}"] if internal else []


def _sections(state: Mapping[str, str], sensors: Mapping[str, str]) -> list[str]:
    """Lines of [state] and [sensors]."""
    lines = ["[state]  # true values: component = column in m, or {column = NAME, unit = cm, rad, deg, or any}"]
    lines += [f"{_quoted(component)} = {value}" for component, value in state.items()] or ['x = ""', 'y = ""']
    lines += ["[sensors]  # sensor = column or list of columns; each is a modality unless [modalities] groups them"]
    return lines + [f"{_quoted(key)} = {value}" for key, value in sensors.items()]


def _means(pattern: str, flat: Sequence[str], rows: Columns, others: set[str]) -> list[str]:
    """Columns of an estimate: single numbers, or one array (T, n). others: its deviations and covariances."""
    arrays = [name for name in _named(pattern, [*rows]) if rows[name].ndim == 2 and name not in others]
    return [name for name in _named(pattern, flat) if name not in others] or arrays[:1]


def _named(pattern: str, names: Sequence[str]) -> list[str]:
    return [n for n in names if re.search(pattern, n, re.IGNORECASE)]


def _topic(topics: Mapping[str, float], name: str) -> str:
    return max((t for t in topics if name == t or name.startswith(f"{t}.")), key=len, default="")


def _components(flat: Sequence[str], rows: Columns, arrays: Sequence[str]) -> dict[str, str]:
    if flat:
        names = {_key(TRUTH_AFFIX.sub("", marked(name)[0])): name for name in flat}
        return names if len(names) == len(flat) else {_key(name): name for name in flat}
    if not arrays or rows[arrays[0]].ndim != 2:
        return {}
    name = arrays[0]
    size = rows[name].shape[1]
    axes = ("x", "y", "yaw") if "pose" in name.lower() else ("x", "y", "z")
    return {f"s{i}" if size > 3 else axes[i]: f"{name}[{i}]" for i in range(size)}


def _key(name: str) -> str:
    return re.sub(r"[^\w-]+", "_", name).strip("_") or "column"


def _quoted(key: str) -> str:
    """A key of TOML, which are letters from A to Z, digits, hyphens and underscores without quotes."""
    return key if key.isascii() else _text(key)


def _text(name: str) -> str:
    """A name as a TOML string: JSON's escapes, and that of DEL."""
    return json.dumps(name, ensure_ascii=False).replace("\x7f", r"\u007f")


def _texts(names: Sequence[str]) -> str:
    return f"[{', '.join(map(_text, names))}]"

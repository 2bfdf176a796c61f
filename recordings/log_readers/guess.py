"""First map of a log, from the names and shapes of its columns; what is unclear is left to the user."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

import numpy as np

from beliefscope.recordings.log_readers.arrays import Columns
from beliefscope.recordings.log_readers.column_map import PLANAR_ELEMENTS, QUATERNION, base_name
from beliefscope.recordings.log_readers.messages import Preview
from beliefscope.recordings.log_readers.table_folder import FILE

TRUTH = r"truth|true|gt|ground|state|mocap|vicon|optitrack"
ESTIMATE = r"(?<![a-z])est|mean|pred|filter|posterior|belief"
STD = r"std|sigma|\u03c3|(^|_)sd(_|$)"  # \u03c3 is the letter sigma
FILTERS = r"ekf|ukf|amcl|slam|kalman|(^|[./])[kp]f[._/]"
POSE_ESTIMATES = (rf"{ESTIMATE}|{FILTERS}|local", r"odom")
"""Patterns of the names of estimated poses: of filters before odometry, which may be that of the wheels."""

CONTROL = r"(^|[/_.])(actions?|controls?|cmd|commands?)([/_.]|$)|^u_?\d*$"
INTERNAL = r"innov|residual|(^|[._/])(nis|nees|ess|n_?eff)([._/]|$)"
"""Pattern of values within a filter, which are neither estimates nor readings."""

VARIANCE = r"(^|[./])(P|cov|covariance)[_.\[(]?\d"
"""Pattern of the elements of a covariance in columns of their own."""

TRUTH_AFFIX = re.compile(r"^(ground_?truth|truth|true|gt|state|mocap|vicon|optitrack)[_./]|_(true|truth|gt)$", re.I)
"""Part of a column's name that marks a true value."""

MARKED_UNIT = re.compile(r"_(deg|cm|mm)$")
"""Unit at the end of a sensor's column."""

UNITS_BY_NAME = {
    **{unit: rf"_{unit}$" for unit in ("deg", "cm", "mm")},
    "rad/s": r"^w[xyz]?$|omega|yaw_?rate|gyro|angular",
    "m/s^2": r"^a[xyz]$|acc",
    "m/s": r"^v[xyz]?$|(^|_)v(el|x|y|z)?(_|$)|velocity|speed",
    "rad": r"_rad$|yaw|heading|theta|roll|pitch|angle",
}
"""Unit of a component -> pattern of its name; the first that matches."""

CHANNEL = re.compile(r"(.+?)[_.]?(x|y|z|lat|lon|alt|east|north|up|\d+)$", re.I)
"""Name of a sensor and of one of its channels."""

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
    time = _named(r"^(t|time|timestamp|stamp)(_s)?$", flat)
    episode = _named(r"^episode(_index|_id)?$", [*columns])
    counters = _named(r"^(frame_|task_)?index$|^__index_level_\d+__$", flat)
    dates = [n for n, values in columns.items() if values.ndim == 1 and values.dtype.kind == "M"]
    time = time or dates[:1]
    state = _components(_named(TRUTH, flat), rows, _named(TRUTH, [*rows]))
    std = _named(STD, flat) or [n for n in _named(STD, [*rows]) if rows[n].ndim == 2][:1]
    elements = _named(VARIANCE, flat)
    mean = next(
        (named for pattern in (ESTIMATE, FILTERS) if (named := _means(pattern, flat, rows, {*std, *elements}))), []
    )
    ensemble = _named(r"ensemble|particle|sample", [n for n in rows if rows[n].ndim == 3])[:1]
    square = [n for n in rows if rows[n].ndim == 3 and rows[n].shape[1] == rows[n].shape[2]]
    covariance = [n for n in square if rows[n].dtype.kind == "f"][:1]
    covariance = covariance or (elements if len(elements) == len(mean) ** 2 else [])
    if not mean and not ensemble:  # of an estimate: without it, they are sensors
        std, covariance = [], []
    control = _named(CONTROL, flat) or _named(CONTROL, [*rows])[:1]
    flags = [n for n in _named(r"contact|touch", flat) if {*np.unique(columns[n]).tolist()} <= {0, 1}][:1]
    used = {*time, *episode, *counters, *state.values(), *mean, *std, *covariance, *ensemble, *control, *flags}
    used |= {n.partition("[")[0] for n in state.values()}
    sensors = _sensors([n for n in columns if n not in used and (n in flat or n in rows)], flat)
    texts = [n for n, values in columns.items() if n not in used and n not in flat and n not in rows and n != FILE]
    lines = [f"time = {_text(time[0])}" if time else f"dt = {DT}  # s per row"]
    lines += [f"episode = {_text(episode[0])}"] if episode else []
    lines += [f"control = {_text(control[0]) if len(control) == 1 else _texts(control)}"] if control else []
    lines += [f"contact = {_text(flags[0])}"] if flags else []
    values = {component: _value(component, reference) for component, reference in state.items()}
    lines += _sections(values, {key: _reading(columns, references) for key, references in sensors.items()})
    if mean or ensemble:
        lines.append("[estimate]")
        # Standard deviations of some components only cannot be imported.
        complete = len(std) == len(mean) or mean[:1] == [name for name in mean if name in rows]
        deviations = std if complete and not covariance else []
        columns_of = {"mean": mean, "std": deviations, "covariance": covariance, "particles": ensemble}
        lines += [f"{key} = {_text(n[0]) if len(n) == 1 else _texts(n)}" for key, n in columns_of.items() if n]
    lines += _unused(internal)
    return lines + ([f"# not numbers, for time, episode or [covariates]: {_texts(texts)}"] if texts else [])


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


def _value(component: str, reference: str) -> str:
    """A component of the state: its column, with the unit that its name implies if it is not m."""
    unit = next((u for u, pattern in UNITS_BY_NAME.items() if re.search(pattern, component, re.I)), "")
    return f'{{column = {_text(reference)}, unit = "{unit}"}}' if unit else _text(reference)


def _sensors(names: Sequence[str], flat: Sequence[str]) -> dict[str, str | list[str]]:
    """Sensor -> columns; single numbers such as gps_x and gps_y are the channels of one sensor."""
    groups: dict[str, list[str]] = {}
    for name in names:
        channel = CHANNEL.fullmatch(name) if name in flat else None
        groups.setdefault(channel[1] if channel else name, []).append(name)
    return {
        _key(group if len(members) > 1 else members[0]): members if len(members) > 1 else members[0]
        for group, members in groups.items()
    }


def _reading(columns: Columns, references: str | list[str]) -> str:
    """Columns of a sensor, with the units at the ends of their names; of a message, those of its fields."""
    value = _text(references) if isinstance(references, str) else _texts(references)
    listed = [references] if isinstance(references, str) else references
    names = [n for ref in listed for n in ([ref] if ref in columns else columns) if n == ref or n.startswith(f"{ref}.")]
    marks = [MARKED_UNIT.search(n) for n in names if columns[n].ndim == 1]
    units = [mark[1] if mark else "" for mark in marks]
    if not any(units):
        return value
    return f"{{column = {value}, unit = {_text(units[0]) if len({*units}) == 1 else _texts(units)}}}"


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
        names = {_key(TRUTH_AFFIX.sub("", name)): name for name in flat}
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

"""Map from the columns of a log to states, sensors and estimates: a short TOML file."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.task import DISPLAY_UNITS, SENSOR_UNITS, Component, axis_name, rotation
from beliefscope.datasets.text import plural

QUATERNION = "quaternion_yaw"
"""Unit of a component whose column is a quaternion (x, y, z, w): the angle about z, in rad."""

ROTATIONS = {"quaternion": (3, 0, 1, 2), "quaternion_wxyz": (0, 1, 2, 3)}
"""Unit of a rotation in space, whose column is a quaternion of any norm -> where its w, x, y and z are."""

UNITS = (
    {"mm": ("m", 1e-3)}
    | dict.fromkeys((QUATERNION, *ROTATIONS), ("rad", 1.0))
    | {display: (unit, 1.0 / factor) for unit, (display, factor) in DISPLAY_UNITS.items() if display}
)
"""Unit of a column -> internal unit, and its factor. Others are internal units."""

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Unit of a column of times -> s."""

SPELLINGS = {
    **dict.fromkeys(("degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
}
"""Names of units that are refused in favour of their symbols: as other units, degrees would be no angle."""

ELEMENTS = re.compile(r"(.*)\[(\d{1,9}(?:,\d{1,9})*)\]")
"""``NAME[I]`` or ``NAME[I,J,...]``: elements of the rows of an array."""

NAMES = ("time", "clock", "episode", "contact")
KEYS = ("task", "dt", *NAMES, "control", "state", "sensors", "modalities", "covariates", "estimate", "innovations")
VALUES = ("mean", "std", "covariance", "particles")
ESTIMATE = ("filter", *VALUES, "weights")

PLANAR_ELEMENTS = "[0,1,5,6,7,11,30,31,35]"
"""x, y and yaw in the covariance of x, y, z, roll, pitch and yaw of a ROS message."""

MARKED_UNIT = re.compile(r"_(deg|rad|cm|mm)$|\s*[\[(]([^\W\dxyz][^\])]*|\u00b0)[\])]$")
"""Unit at the end of a column's name: ``yaw_deg``, ``x [m]``."""

References = str | list[str]

MeanReferences = References | list[str | list[str]]
"""Columns of a mean: a quaternion may have a list of four."""


def base_name(reference: str) -> str:
    """Name of a column without the elements of its rows."""
    return match[1] if (match := ELEMENTS.fullmatch(reference)) else reference


def marked(name: str) -> tuple[str, str]:
    """A column's name without the unit at its end, and the symbol of the unit; the name and "" without one."""
    if not (mark := MARKED_UNIT.search(name)):
        return name, ""
    unit = (mark[1] or mark[2]).strip()
    return name[: mark.start()], SPELLINGS.get(unit.lower(), unit)


def listed(references: MeanReferences) -> list[str]:
    parts = [references] if isinstance(references, str) else references
    return [name for part in parts for name in ([part] if isinstance(part, str) else part)]


def _distinct(names: Sequence[str]) -> list[str]:
    """Names without the part that all begin with, up to its last separator; slashes are points."""
    starts = [names[0][: match.end()] for match in re.finditer(r"[._/ ]", names[0])]
    shared = max((len(start) for start in starts if all(name.startswith(start) for name in names)), default=0)
    return [name[shared:].replace("/", ".") for name in names]


def internal_units(unit: References, size: int, what: str) -> list[tuple[str, float]]:
    """Internal unit of each of ``size`` channels, and its factor. Raises BadInput for another number of units."""
    units = [unit] * size if isinstance(unit, str) else unit
    if len(units) != size:
        raise BadInput(f"{what} has {plural(size, 'channel')} and {plural(len(units), 'unit')}")
    return [UNITS.get(each, (each, 1.0)) for each in units]


@dataclass(frozen=True)
class StateColumn:
    """Column of a component's true value, empty if it is unknown, and its unit. Quaternions may have four columns."""

    column: References
    unit: str = "m"

    @property
    def size(self) -> int:
        """Number of state components: 3 for a rotation."""
        return 3 if self.unit in ROTATIONS else 1

    @property
    def internal(self) -> tuple[str, float]:
        """Unit of the state component, and its factor; the same unit if it is not in ``UNITS``."""
        return UNITS.get(self.unit, (self.unit, 1.0))


@dataclass(frozen=True)
class CovariateColumn:
    """Column of a covariate: text is categorical, zeros and ones boolean, other numbers continuous with ``cuts``."""

    column: str
    cuts: tuple[float, ...] = ()
    unit: str = ""


@dataclass(frozen=True)
class InnovationColumns:
    """Columns of the innovations of a modality, of their covariance S or standard deviations, and of its gate."""

    innovation: References
    covariance: References = ""
    std: References = ""
    accepted: str = ""
    unit: References = ""

    @property
    def references(self) -> set[str]:
        return {*listed(self.innovation), *listed(self.covariance), *listed(self.std), self.accepted} - {""}


@dataclass(frozen=True)
class ColumnMap:
    """What the columns of a log are.

    Attributes:
        task: name of the new task.
        dt: seconds per row, or per step of logs of messages; None if ``time``, a column in s, or ``clock`` is given.
        clock: topic of logs of messages whose messages are the steps.
        time: column, or timeline of a Rerun recording. time_unit: of the column, one of ``TIME_UNITS``.
        episode: column that numbers or names the episodes; empty for a single one.
        state: component -> its column. control: columns. contact: column that is not zero in contact.
        sensors: name -> columns, or one column of images. covariates: name -> column.
        valid: sensor -> column that is not zero at the steps with a reading of it.
        modalities: name -> its sensors.
        estimate: recorded estimate: ``filter``: its name; ``mean``; ``std`` or ``covariance``; or ``particles``
            (rows of M n numbers) in their place; ``weights``: modality -> column. Empty for a log without estimates.
        units: sensor -> unit of its channels, or one for each. innovations: modality -> its columns.
    """

    task: str
    state: Mapping[str, StateColumn]
    dt: float | None = None
    time: str = ""
    time_unit: str = "s"
    clock: str = ""
    episode: str = ""
    control: References = field(default_factory=list)
    contact: str = ""
    sensors: Mapping[str, References] = field(default_factory=dict)
    valid: Mapping[str, str] = field(default_factory=dict)
    modalities: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    covariates: Mapping[str, CovariateColumn] = field(default_factory=dict)
    estimate: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, References] = field(default_factory=dict)
    innovations: Mapping[str, InnovationColumns] = field(default_factory=dict)

    @property
    def factors(self) -> np.ndarray:
        """(n,) internal units per unit of each component's column."""
        return np.array([entry.internal[1] for entry in self.state.values() for _ in range(entry.size)])

    @property
    def components(self) -> tuple[Component, ...]:
        """The n state components."""
        parts = [
            rotation(name) if entry.size > 1 else (Component(name, entry.internal[0]),)
            for name, entry in self.state.items()
        ]
        return tuple(component for part in parts for component in part)

    def channels(self, sizes: Mapping[str, int]) -> dict[str, tuple[Component, ...]]:
        """Names of channels that are columns of their own, after what all begin with: ``lat`` of ``gps_lat``.

        sizes: number of channels of vector sensors and of ``control``.
        """
        references = {**self.sensors, "control": self.control}
        columns = {key: listed(references[key]) for key, size in sizes.items() if size > 1}
        # Readings are converted, so the unit of a column is not part of the channel's name.
        own = {key: [marked(n)[0] if key in self.units else n for n in each] for key, each in columns.items()}
        names = {key: _distinct(each) for key, each in own.items()}
        names = {key: each for key, each in names.items() if len({*each} - {""}) == sizes[key]}
        for key in [key for key in self.units if key in sizes and key not in names]:
            names[key] = [axis_name("", i, sizes[key]).strip() or key for i in range(sizes[key])]
        units = {key: [unit for unit, _ in self.internal_units(key, sizes[key])] for key in names}
        return {key: tuple(map(Component, each, units[key])) for key, each in names.items()}

    def internal_units(self, key: str, size: int) -> list[tuple[str, float]]:
        """Internal unit of each of the channels of a sensor, and its factor from that of the column."""
        return internal_units(self.units.get(key, SENSOR_UNITS.get(key, "")), size, f"sensor {key!r}")

    @property
    def truth(self) -> set[str]:
        """References to columns of the true state."""
        return {name for component in self.state.values() for name in listed(component.column) if name}

    @property
    def estimated(self) -> set[str]:
        """References to columns of the recorded estimate, without its fusion weights."""
        return {name for key in VALUES for name in listed(self.estimate.get(key, []))}

    @property
    def required(self) -> set[str]:
        """References to columns that have values at all steps: state, sensors, control, estimate and episode."""
        weights = self.estimate.get("weights", {}).values()
        parts = (*self.sensors.values(), self.control, *weights)
        return self.truth | self.estimated | {name for part in parts for name in listed(part)} | ({self.episode} - {""})

    @property
    def references(self) -> set[str]:
        """References to all columns but ``time``."""
        others = {self.contact, *self.valid.values(), *(covariate.column for covariate in self.covariates.values())}
        innovations = {name for entry in self.innovations.values() for name in entry.references}
        return self.required | innovations | (others - {""})


def read_map(path: Path) -> ColumnMap:
    """Read a map. Raises BadInput for a damaged file, unknown keys and wrong types."""
    text = ""
    try:
        text = path.read_text()
        values = tomllib.loads(text)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadInput(f"{path.name} cannot be read: {error!s:.200}{_quoting(str(error), text)}") from None
    for key in values:
        check_name(f"key of {path.name}", key, KEYS)
    sensors, estimate = (_table(values, name, path) for name in ("sensors", "estimate"))
    settings = {name: _sensor(name, value) for name, value in sensors.items() if isinstance(value, dict)}
    sensors = {**sensors, **{name: value["column"] for name, value in settings.items()}}
    valid, units = ({n: value[key] for n, value in settings.items() if key in value} for key in ("valid", "unit"))
    for key in estimate:
        check_name("key of [estimate]", key, ESTIMATE)
    dt = values.get("dt")
    has_time = dt is not None or "time" in values or "clock" in values
    if not has_time or not (dt is None or (type(dt) in (int, float) and 0 < dt < math.inf)):
        raise BadInput(f"{path.name} needs either dt, in s and more than 0, or time, the name of a column in s")
    if "clock" in values and dt is not None:
        raise BadInput(f"{path.name} has dt and clock, expected dt or the topic whose messages are the steps")
    state = {name: _component(name, value) for name, value in _table(values, "state", path).items()}
    if not state:
        raise BadInput(f'[state] of {path.name} has no components, expected one or more: name = "column"')
    names = {key: values.get(key, "") for key in NAMES}
    names["time"], time_unit = _time(names["time"])
    control = values.get("control", [])
    estimated = {key: estimate[key] for key in VALUES if key in estimate} | {"mean": _mean(estimate.get("mean", []))}
    lists = [("control", control), *sensors.items(), *estimated.items()]
    for key, value in (*names.items(), *lists, *_table(estimate, "weights", path).items()):
        if not isinstance(value, str) and not (_texts(value) and (key, value) in lists):
            raise BadInput(f"{key} in {path.name} is {value!r:.100}, expected the name of a column or a list of names")
    covariates = {name: _covariate(name, value) for name, value in _table(values, "covariates", path).items()}
    task = values.get("task", path.stem)
    modalities = _modalities(_table(values, "modalities", path), sensors, path)
    innovations = {n: _innovation(n, v, modalities) for n, v in _table(values, "innovations", path).items()}
    columns = {"control": control, "sensors": sensors, "valid": valid, "units": units, "modalities": modalities}
    columns |= {"innovations": innovations, "time_unit": time_unit}
    return ColumnMap(task, state, dt, covariates=covariates, estimate=estimate, **columns, **names)


def _time(value: Any) -> tuple[Any, str]:
    """Column of the times, and its unit."""
    if not isinstance(value, dict):
        return value, "s"
    if not {"column"} <= value.keys() <= {"column", "unit"}:
        raise BadInput(f"time is {value!r:.100}, expected a column or {{column = NAME, unit = UNIT}}")
    check_name("unit of time", str(unit := value.get("unit", "s")), TIME_UNITS)
    return value["column"], unit


def _mean(value: Any) -> Any:
    """A mean with the four columns of each quaternion as entries of their own."""
    if not isinstance(value, list):
        return value
    return [name for part in value for name in (part if _texts(part) and len(part) == 4 else [part])]


def _quoting(error: str, text: str) -> str:
    """A hint for an error of TOML in a line with a letter that names have in quotes only; else empty."""
    number = re.search(r"at line (\d+)", error)
    line = text.split("\n")[int(number[1]) - 1] if number else ""
    name = re.search(r"[\w-]*[^\W\x00-\x7f][\w-]*", re.sub(r"\"[^\"]*\"|'[^']*'|#.*", "", line))
    return f'; names with other letters than A to Z are quoted: "{name[0]}"' if name else ""


def _table(values: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    table = values.get(name, {})
    if not isinstance(table, dict):
        raise BadInput(f"{name} in {path.name} is {table!r:.100}, expected a table: [{name}]")
    return table


def _modalities(table: Mapping[str, Any], sensors: Mapping[str, Any], path: Path) -> dict[str, tuple[str, ...]]:
    for name, keys in table.items():
        if not _texts(keys) or not keys:
            raise BadInput(f"modality {name!r} in {path.name} is {keys!r:.100}, expected a list of sensors")
        for key in keys:
            check_name(f"sensor of modality {name!r}", key, sensors)
    grouped = [key for keys in table.values() for key in keys]
    own = {name: (name,) for name in sensors if name not in grouped}
    if both := own.keys() & table:
        raise BadInput(f"{min(both)!r} in {path.name} is a modality and a sensor of no modality; rename one of them")
    return own | {name: tuple(keys) for name, keys in table.items()}


def _component(name: str, value: Any) -> StateColumn:
    settings = {"column": value} if isinstance(value, str) else value
    if not isinstance(settings, dict) or "column" not in settings or not settings.keys() <= {"column", "unit"}:
        raise BadInput(f"state {name!r} is {value!r:.100}, expected a column or {{column = NAME, unit = UNIT}}")
    column, unit = settings["column"], settings.get("unit", "m")
    if not isinstance(unit, str):
        raise BadInput(f"unit of state {name!r} is {unit!r:.100}, expected a text such as m, cm, rad, deg or m/s")
    _check_spelling(f"state {name!r}", unit)
    quaternions = (QUATERNION, *ROTATIONS)
    if not isinstance(column, str) and not (unit in quaternions and _texts(column) and len(column) == 4):
        raise BadInput(f"column of state {name!r} is {column!r:.100}, expected a name, or four of a quaternion")
    return StateColumn(column, unit)


def _sensor(name: str, value: dict[str, Any]) -> dict[str, Any]:
    """Checked settings of a sensor: ``column``, ``valid`` and ``unit``."""
    if (
        "column" not in value
        or not value.keys() <= {"column", "valid", "unit"}
        or not isinstance(value.get("valid", ""), str)
    ):
        expected = "columns or {column = NAME, valid = NAME, unit = UNIT}"
        raise BadInput(f"sensor {name!r} is {value!r:.100}, expected {expected}")
    _check_unit(f"sensor {name!r}", value.get("unit", ""))
    return value


def _innovation(name: str, value: Any, modalities: Mapping[str, Any]) -> InnovationColumns:
    check_name("modality of [innovations]", name, modalities)
    keys = ("innovation", "covariance", "std", "accepted", "unit")
    valid = isinstance(value, dict) and value.keys() <= {*keys} and ("covariance" in value) != ("std" in value)
    if not (valid and "innovation" in value and all(isinstance(v, str) or _texts(v) for v in value.values())):
        expected = "{innovation = COLUMNS, covariance = COLUMNS or std = COLUMNS, accepted = NAME, unit = UNIT}"
        raise BadInput(f"innovations of {name!r} are {value!r:.100}, expected {expected}")
    _check_unit(f"innovations of {name!r}", value.get("unit", ""))
    return InnovationColumns(**value)


def _check_unit(what: str, unit: Any) -> None:
    """Raise BadInput unless this is a unit of readings, or a list of units."""
    if not isinstance(unit, str) and not _texts(unit):
        raise BadInput(f"unit of {what} is {unit!r:.100}, expected a text such as deg or m/s, or one for each")
    for each in [unit] if isinstance(unit, str) else unit:
        _check_spelling(what, each)
        if each in (QUATERNION, *ROTATIONS):
            raise BadInput(f"unit of {what} is {each!r}, which is one of the state only")


def _check_spelling(what: str, unit: str) -> None:
    if symbol := SPELLINGS.get(unit.strip().lower()):
        raise BadInput(f"unit of {what} is {unit!r}, expected {symbol!r}")


def _covariate(name: str, value: Any) -> CovariateColumn:
    settings = {"column": value} if isinstance(value, str) else value
    valid = isinstance(settings, dict) and {"column"} <= settings.keys() <= {"column", "cuts", "unit"}
    if valid:
        cuts, unit = settings.get("cuts", []), settings.get("unit", "")
        numbers = isinstance(cuts, list) and all(type(cut) in (int, float) for cut in cuts)
        if numbers and sorted(set(cuts)) == cuts and isinstance(settings["column"], str) and isinstance(unit, str):
            return CovariateColumn(settings["column"], tuple(map(float, cuts)), unit)
    raise BadInput(
        f"covariate {name!r} is {value!r:.100}, expected a column or {{column = NAME, cuts = [ascending], unit = UNIT}}"
    )


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)

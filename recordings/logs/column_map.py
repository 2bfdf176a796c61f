"""Map from the columns of a log to states, sensors and estimates: a short TOML file."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.recordings.logs.columns import Columns

UNITS = {"m": ("m", 1.0), "cm": ("m", 0.01), "mm": ("m", 0.001), "rad": ("rad", 1.0), "deg": ("rad", math.pi / 180.0)}
"""Unit of a column -> internal unit, and its factor."""

KEYS = ("task", "dt", "time", "episode", "control", "contact", "state", "sensors", "covariates", "estimate")
VALUES = ("mean", "std", "covariance", "particles")
ESTIMATE = ("filter", *VALUES, "weights")

References = str | list[str]


@dataclass(frozen=True)
class StateColumn:
    """Column of a component's true value, empty if it is unknown, and its unit."""

    column: str
    unit: str = "m"

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
class ColumnMap:
    """What the columns of a log are.

    Attributes:
        task: name of the new task.
        dt: seconds per row; None if ``time``, a column in s, is given.
        episode: column that numbers or names the episodes; empty for a single one.
        state: component -> its column. control: columns. contact: column that is not zero in contact.
        sensors: modality -> columns, or one column of images. covariates: name -> column.
        estimate: recorded estimate: ``filter``: its name; ``mean``; ``std`` or ``covariance``; or ``particles``
            (rows of M n numbers) in their place; ``weights``: modality -> column. Empty for a log without estimates.
    """

    task: str
    state: Mapping[str, StateColumn]
    dt: float | None = None
    time: str = ""
    episode: str = ""
    control: References = field(default_factory=list)
    contact: str = ""
    sensors: Mapping[str, References] = field(default_factory=dict)
    covariates: Mapping[str, CovariateColumn] = field(default_factory=dict)
    estimate: Mapping[str, Any] = field(default_factory=dict)

    @property
    def factors(self) -> np.ndarray:
        """(n,) internal units per unit of each component's column."""
        return np.array([component.internal[1] for component in self.state.values()])


def read_map(path: Path) -> ColumnMap:
    """Read a map. Raises BadInput for a damaged file, unknown keys and wrong types."""
    try:
        values = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadInput(f"{path.name} cannot be read: {error!s:.200}") from None
    for key in values:
        check_name(f"key of {path.name}", key, KEYS)
    sensors, estimate = (_table(values, name, path) for name in ("sensors", "estimate"))
    for key in estimate:
        check_name("key of [estimate]", key, ESTIMATE)
    dt = values.get("dt")
    if (dt is None) == ("time" not in values) or not (dt is None or (type(dt) in (int, float) and dt > 0)):
        raise BadInput(f"{path.name} needs either dt, in s and more than 0, or time, the name of a column in s")
    state = {name: _component(name, value) for name, value in _table(values, "state", path).items()}
    if len(state) < 2:
        raise BadInput(f'[state] of {path.name} has {len(state)} components, expected two or more: name = "column"')
    names = {key: values.get(key, "") for key in ("time", "episode", "contact")}
    control = values.get("control", [])
    lists = [("control", control), *sensors.items(), *((key, estimate[key]) for key in VALUES if key in estimate)]
    for key, value in (*names.items(), *lists, *_table(estimate, "weights", path).items()):
        if not isinstance(value, str) and not (_texts(value) and (key, value) in lists):
            raise BadInput(f"{key} in {path.name} is {value!r:.100}, expected the name of a column or a list of names")
    covariates = {name: _covariate(name, value) for name, value in _table(values, "covariates", path).items()}
    task = values.get("task", path.stem)
    return ColumnMap(
        task, state, dt, control=control, sensors=sensors, covariates=covariates, estimate=estimate, **names
    )


def guess_map(columns: Columns, name: str) -> str:
    """Text of a first map: columns are assigned by their names and shapes; what is unclear is left to the user."""
    flat = [n for n, values in columns.items() if values.ndim == 1 and values.dtype.kind in "fiub"]
    rows = {n: values for n, values in columns.items() if values.ndim > 1}

    def named(pattern: str, names: list[str]) -> list[str]:
        return [n for n in names if re.search(pattern, n, re.IGNORECASE)]

    time = named(r"^(t|time|timestamp|stamp)(_s)?$", flat)
    truth, estimates = r"truth|true|gt|ground|state", r"est|mean|pred|filter|posterior|belief"
    state = _components(named(truth, flat), rows, named(truth, [*rows]))
    std = named(r"std|sigma|(^|_)sd(_|$)", flat)
    mean = [n for n in named(estimates, flat) if n not in std] or [
        n for n in named(estimates, [*rows]) if rows[n].ndim == 2
    ][:1]
    covariance = [n for n in rows if rows[n].ndim == 3 and rows[n].shape[1] == rows[n].shape[2]][:1]
    ensemble = named(r"ensemble|particle|sample", [n for n in rows if rows[n].ndim == 3])[:1]
    used = {*time, *state.values(), *mean, *std, *covariance, *ensemble, *(n.partition("[")[0] for n in state.values())}
    sensors = [n for n in columns if n not in used and (n in flat or n in rows)]
    lines = [f'task = "{re.sub(r"[^A-Za-z0-9_.-]", "-", name)}"']
    lines.append(f'time = "{time[0]}"' if time else "dt = 0.1  # s per row")
    lines += ["[state]  # true values: component = column, or {column = NAME, unit = m, cm, mm, rad or deg}"]
    lines += [f'{component} = "{reference}"' for component, reference in state.items()] or ['x = ""', 'y = ""']
    lines += ["[sensors]  # modality = column or list of columns"] + [f'{_key(n)} = "{n}"' for n in sensors]
    if mean or ensemble:
        lines.append("[estimate]")
        found = {"mean": mean, "std": std if not covariance else [], "covariance": covariance, "particles": ensemble}
        lines += [f"{key} = {json.dumps(n[0] if len(n) == 1 else n)}" for key, n in found.items() if n]
    return "\n".join(lines) + "\n"


def _components(flat: list[str], rows: Columns, arrays: list[str]) -> dict[str, str]:
    if flat:
        return {_key(name): name for name in flat}
    if not arrays or rows[arrays[0]].ndim != 2:
        return {}
    name = arrays[0]
    return {f"s{i}" if rows[name].shape[1] > 3 else "xyz"[i]: f"{name}[{i}]" for i in range(rows[name].shape[1])}


def _key(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)


def _table(values: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    table = values.get(name, {})
    if not isinstance(table, dict):
        raise BadInput(f"{name} in {path.name} is {table!r:.100}, expected a table: [{name}]")
    return table


def _component(name: str, value: Any) -> StateColumn:
    settings = {"column": value} if isinstance(value, str) else value
    if not isinstance(settings, dict) or not isinstance(settings.get("column"), str) or len(settings) > 2:
        raise BadInput(f"state {name!r} is {value!r:.100}, expected a column or {{column = NAME, unit = UNIT}}")
    unit = settings.get("unit", "m")
    if not isinstance(unit, str):
        raise BadInput(f"unit of state {name!r} is {unit!r:.100}, expected a text such as m, cm, rad, deg or m/s")
    return StateColumn(settings["column"], unit)


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

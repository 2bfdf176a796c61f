"""The definition of a task as JSON, which data sets, traces, live files, recordings and checkpoints contain.

A definition is data: reading one runs no code. The functions of a task (``FUNCTIONS``) are not part of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_args

import numpy as np

from beliefscope.datasets.covariate import CONTACT, Covariate, Kind
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.ingredient import Ingredient
from beliefscope.datasets.simulation.camera import Camera
from beliefscope.datasets.task import Component, Task
from beliefscope.datasets.text import plural

FUNCTIONS = ("replay", "outline", "ridge_direction", "simulate")
"""Fields of a task that are code."""

LAYOUT = ("name", "components", "observations", "modalities", "control_size")
"""Fields that determine the arrays of a task's episodes."""

LARGEST_SIZE = 1 << 24  # of one axis of an observation, and of other whole numbers


def task_to_json(task: Task) -> dict[str, Any]:
    """All fields except the functions, as JSON values."""
    return {f.name: _plain(getattr(task, f.name)) for f in fields(Task) if f.name not in FUNCTIONS}


def task_from_json(values: Any) -> Task:
    """Inverse of ``task_to_json``, without functions. Raises BadInput for an invalid definition."""
    try:
        task = Task(
            name=values["name"],
            components=tuple(_component(c) for c in values["components"]),
            observations=_tuples(values["observations"]),
            modalities=_tuples(values["modalities"]),
            control_size=values["control_size"],
            dt=values["dt"],
            map_components=tuple(values["map_components"]),
            map_half_width=values["map_half_width"],
            positions=_tuples(values["positions"]),
            camera=None if values["camera"] is None else _camera(values["camera"]),
            ingredients={
                name: Ingredient(i["meaning"], _tuples(i["ranges"])) for name, i in values["ingredients"].items()
            },
            start_distance=_tuples(values["start_distance"]),
            warmup=values["warmup"],
            arrays=tuple(values.get("arrays", ())),  # definitions of earlier versions lack it
            periods=dict(values.get("periods", {})),
            masks=dict(values.get("masks", {})),
            scans=_tuples(values.get("scans", {})),
            clouds=tuple(values.get("clouds", ())),
            channels={key: tuple(map(_component, each)) for key, each in values.get("channels", {}).items()},
            **_covariates(values),
        )
        if not values["map_components"]:  # ``Task`` has chosen them; a stored definition names them
            raise BadInput("the definition's map components are [], expected one or two names.")
        check_definition(task, stored=True)
    except BadInput:
        raise
    except (AttributeError, IndexError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"incomplete definition of a task: {type(error).__name__}: {error!s:.200}") from None
    return task


def _component(values: Mapping[str, Any]) -> Component:
    display = values.get("display")
    return Component(
        values["name"],
        values["unit"],
        values["static"],
        None if display is None else (display[0], display[1]),
        values.get("rotation", ""),  # definitions of earlier versions lack it
        values.get("wraps", False),
    )


def _covariates(values: Mapping[str, Any]) -> dict[str, Any]:
    """The covariates; definitions of earlier versions have none, and mean contact."""
    if "covariates" not in values:
        return {"covariates": {"contact": CONTACT}}
    covariates = {
        name: Covariate(c["kind"], tuple(c["groups"]), tuple(c["cuts"]), c["unit"])
        for name, c in values["covariates"].items()
    }
    return {"covariates": covariates}


def _camera(values: Mapping[str, Any]) -> Camera:
    """Raises BadInput for values of the wrong type."""
    vectors = [tuple(map(float, values[name])) for name in ("position", "forward", "up")]
    if any(len(vector) != 3 or not math.isfinite(sum(vector)) for vector in vectors):
        raise BadInput(f"the camera of a task is {values!r:.200}")
    (px, py, pz), (fx, fy, fz), (ux, uy, uz) = vectors
    camera = Camera(
        (px, py, pz), (fx, fy, fz), (ux, uy, uz), values["field_of_view"], values["size"], values["oversampling"]
    )
    sizes = all(_whole(size, 1) and size <= 4096 for size in (camera.size, camera.oversampling))
    if not (sizes and _positive(camera.field_of_view)):
        raise BadInput(f"the camera of a task is {values!r:.200}")
    return camera


def with_functions(task: Task, source: Task) -> Task:
    """The task with the functions of another one of the same layout; the other one itself if they are equal."""
    if task_to_json(task) == task_to_json(source):
        return source
    return replace(task, **{name: getattr(source, name) for name in FUNCTIONS})


def difference(task: Task, other: Task) -> str:
    """The first difference of ``other`` in the name and the arrays of episodes; empty if there is none.

    Units for display may differ: those of imported logs depend on the span of the positions.
    """
    if task is other:
        return ""
    for name in LAYOUT:
        expected, value = (_plain(getattr(t, name)) for t in (task, other))
        if name == "components":
            expected, value = ([{**part, "display": None} for part in parts] for parts in (expected, value))
            pairs = zip(expected, value, strict=False)
            value = next(([v] for e, v in pairs if v != e), value) if value != expected else value
        if value != expected:
            same = name != "name" and f" with the same name {task.name!r} but other {name}"
            return f"a task{same}: {value!r:.200}" if same else f"task {other.name!r}"
    return ""


def check_definition(task: Task, where: str = "", stored: bool = False) -> None:
    """Raise BadInput for a wrong type or inconsistent fields.

    where: origin of the task, for messages. stored: it is of a file, whose names may be those of an earlier version.
    """
    place = where or f"task {task.name!r:.200}"
    if not isinstance(task.name, str) or not task.name or len(task.name) > 100 or set(task.name) & set("/\\: "):
        raise BadInput(f"{place} is named {task.name!r:.200}, expected a name without spaces, colons and slashes.")
    _check_components(task, place)
    if not stored:
        check_names(task, place)
    _check_sensors(task, place)
    _check_channels(task, place)
    _check_points(task, place)
    _check_covariates(task, place)
    for name, value in (("control_size", task.control_size), ("warmup", task.warmup)):
        if not _whole(value, 0):
            raise BadInput(f"{place}: {name} is {value!r:.200}, expected a whole number.")
    if not (_positive(task.dt) and _positive(task.map_half_width)):
        raise BadInput(
            f"{place}: dt is {task.dt!r} s and map_half_width {task.map_half_width!r}, expected more than 0."
        )
    for unit, ends in task.start_distance.items():
        if unit not in {c.unit for c in task.components} or len(ends) != 2 or not all(_number(end) for end in ends):
            raise BadInput(f"{place}: start distance of {unit!r} is {ends!r:.200}, expected two numbers.")


def _check_components(task: Task, place: str) -> None:
    """Components, their rotations, and those of the map and of positions."""
    names = [component.name for component in task.components]
    if not names or len(set(map(repr, names))) < len(names):
        raise BadInput(f"{place} has the components {names!r:.200}, expected one or more with different names.")
    for component in task.components:
        _check_component(component, f"{place}: component {component.name!r:.200}")
    for name in dict.fromkeys(component.rotation for component in task.components):
        parts = [i for i, component in enumerate(task.components) if name and component.rotation == name]
        alike = {task.components[i].unit for i in parts} == {"rad"} and [*np.diff(parts)] == [1, 1]
        if not isinstance(name, str) or (name and not alike):
            raise BadInput(f"{place}: rotation {name!r:.200} has {plural(len(parts), 'component')}, not 3 of unit rad.")
    if len(set(task.map_indices)) != len(task.map_components) or len(task.map_components) not in (1, 2):
        raise BadInput(f"{place}: map components are {list(task.map_components)!r:.200}, expected one or two names.")
    if task.positions and len(task.main_error.indices) != 2:
        raise BadInput(f"{place}: positions {list(task.positions)!r:.200} need two map components of one unit.")
    for key, channels in task.positions.items():
        if len(channels) != 2 or not all(_whole(channel, 0) for channel in channels):
            raise BadInput(f"{place}: positions of {key!r} are {channels!r:.200}, expected two channels.")


def _check_sensors(task: Task, place: str) -> None:
    """Observations, their shapes and periods, and the modalities that have them."""
    for key, shape in task.observations.items():
        if not shape or not all(_whole(size, 1) for size in shape):
            raise BadInput(f"{place}: observation {key!r} has shape {shape!r:.200}, expected whole numbers above 0.")
        if key not in (*task.arrays, *task.clouds) and len(shape) > 2 and (len(shape) > 3 or shape[2] != 3):
            raise BadInput(
                f"{place}: observation {key!r} has shape {shape!r:.200}, expected (d,), (H, W) or (H, W, 3), or "
                f"its name in arrays."
            )
    if unknown := [key for key in task.arrays if key not in task.observations]:
        raise BadInput(f"{place}: arrays has {unknown[0]!r:.200}, which is not an observation.")
    for key, period in task.periods.items():
        if key not in task.observations or not _positive(period):
            raise BadInput(
                f"{place}: period of {key!r:.200} is {period!r:.200}, expected an observation and s above 0."
            )
    for modality, keys in task.modalities.items():
        missing = [key for key in keys if key not in task.observations]
        if missing:
            raise BadInput(f"{place}: modality {modality!r} has {missing[0]!r}, which is not an observation.")
        if not keys:
            raise BadInput(f"{place}: modality {modality!r} has no observations.")


def check_names(task: Task, where: str = "") -> None:
    """Raise BadInput for a name with a slash or plus sign where statistics contain it or names are joined.

    where: origin of the task, for messages.
    """
    place = where or f"task {task.name!r:.200}"
    components = [component.name for component in task.components]
    kinds = ("component", components, "/"), ("observation", task.observations, "/"), ("modality", task.modalities, "/+")
    for kind, names, excluded in kinds:
        for name in names:
            _check_name(name, f"{place}: {kind} {name!r:.200}", excluded)


def _check_name(name: object, about: str, excluded: str = "/") -> None:
    """Raise BadInput for a name with a separator of statistics or files, or of joined modalities.

    about: start of the message.
    """
    if not isinstance(name, str) or not name or set(name) & set(excluded):
        raise BadInput(f"{about} has an invalid name, expected a text without {' and '.join(excluded)}.")


def _check_component(component: Component, about: str) -> None:
    """about: start of the message."""
    if not isinstance(component.name, str) or component.static not in (0, 1):
        raise BadInput(f"{about} is static {component.static!r:.200}, expected a name, and true or false.")
    if not isinstance(component.unit, str) or len(component.unit) > 40:
        raise BadInput(f"{about} has unit {component.unit!r:.200}, expected a text.")
    if component.wraps not in (0, 1) or (component.wraps and (component.unit != "rad" or component.rotation)):
        raise BadInput(f"{about} has wraps {component.wraps!r:.200}, expected true for an angle in rad only.")
    unit, factor = component.conversion
    if not isinstance(unit, str) or not _positive(factor) or (component.display and component.unit == "rad"):
        raise BadInput(f"{about} has display {component.display!r:.200}, expected a unit and a factor above 0.")


def _check_channels(task: Task, place: str) -> None:
    """Names and units of the channels of vectors and controls."""
    for key, channels in task.channels.items():
        shape = (task.control_size,) if key == "control" else task.observations.get(key, ())
        if len(shape) != 1 or len(channels) != shape[0]:
            expected = f"{shape[0]} names" if len(shape) == 1 else "an observation (d,) or control"
            raise BadInput(f"{place}: channels of {key!r:.200} are {len(channels)}, expected {expected}.")
        for channel in channels:
            about = f"{place}: channel {channel.name!r:.200} of {key!r:.200}"
            _check_component(channel, about)
            _check_name(channel.name, about)
        if len({channel.name for channel in channels}) < len(channels):
            raise BadInput(f"{place}: channels of {key!r:.200} have equal names.")


def _check_points(task: Task, place: str) -> None:
    """Scans and point clouds."""
    for key, angles in task.scans.items():
        shape = task.observations.get(key, ())
        if len(shape) != 1 or shape[0] < 2:
            raise BadInput(f"{place}: scan {key!r:.200} has shape {shape!r:.200}, expected ranges (d,).")
        valid = len(angles) == 2 and all(map(_number, angles))
        if not valid or not 0.0 < angles[1] - angles[0] <= 2.0 * math.pi + 1e-6:
            raise BadInput(
                f"{place}: scan {key!r:.200} has angles {angles!r:.200}, expected two in rad, ascending, within a turn."
            )
    for key in task.clouds:
        shape = task.observations.get(key, ())
        if len(shape) != 2 or shape[1] < 2:
            raise BadInput(
                f"{place}: point cloud {key!r:.200} has shape {shape!r:.200}, expected (P, 2), (P, 3) or more columns."
            )


def _check_covariates(task: Task, place: str) -> None:
    groups = ["all", "blackout"]
    for name, covariate in task.covariates.items():
        if not isinstance(covariate, Covariate):
            raise BadInput(f'{place}: covariate {name!r:.200} is {covariate!r:.200}, expected Covariate("boolean").')
        where, cuts = f"{place}: covariate {name!r:.200}", covariate.cuts
        _check_name(name, where)
        if covariate.kind not in get_args(Kind) or not isinstance(covariate.unit, str):
            raise BadInput(f"{where} has kind {covariate.kind!r:.200}, expected one of {', '.join(get_args(Kind))}.")
        if not all(map(_number, cuts)) or list(cuts) != sorted(set(cuts)) or (cuts and covariate.kind != "continuous"):
            raise BadInput(f"{where} has cuts {cuts!r:.200}, expected ascending numbers of a continuous covariate.")
        expected = {"boolean": 2, "continuous": len(cuts) + 1 if cuts else 0}.get(covariate.kind, len(covariate.groups))
        if not all(isinstance(group, str) and group for group in covariate.groups) or (
            len(covariate.groups) not in ((0, expected) if covariate.kind != "categorical" else range(1, 1000))
        ):
            raise BadInput(f"{where} has groups {covariate.groups!r:.200}, expected {expected or 'one or more'} names.")
        groups += covariate.group_names(name)
    flags = [name for name, covariate in task.covariates.items() if covariate.kind == "boolean" and name != "contact"]
    for key, name in task.masks.items():
        if key not in task.observations or name not in flags or [*task.masks.values()].count(name) > 1:
            raise BadInput(
                f"{place}: mask of {key!r:.200} is {name!r:.200}, expected an observation and a boolean covariate of "
                f"its own: {', '.join(flags) or 'there is none'}."
            )
    if len(set(groups)) < len(groups):
        raise BadInput(f"{place}: groups of its covariates have the same name: {', '.join(groups):.200}.")


def _whole(value: Any, smallest: int) -> bool:
    return type(value) is int and smallest <= value <= LARGEST_SIZE


def _number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _positive(value: Any) -> bool:
    return _number(value) and value > 0


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    """Dataclasses (their compared fields) and mappings as dictionaries, tuples as lists."""
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value) if f.compare}
    if isinstance(value, Mapping):
        return {name: _plain(v) for name, v in value.items()}
    return [*map(_plain, value)] if isinstance(value, list | tuple) else value

"""How traces and cursors travel between the server and the page (docs/api.md). Binary is little-endian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.faults.injection import WHOLE, Faults
from beliefscope.datasets.task import Task
from beliefscope.filters.training.study import nees_bounds
from beliefscope.inspect.diagnostics.consistency import innovations
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

LARGEST_ANGLE = 1e3  # rad: no door turns farther
MAP_SIZES = (41, 135)  # cells a side: what a drag shows, and the fine one that follows
SENSORS = ("effector_position", "force")


@dataclass(frozen=True)
class Cursor:
    """The page's whole selection, as one message of it says.

    Serial: the page's own count of its cursors. Faults: how the sensors are broken. Scene: whether the 3D scene
    follows, or only the maps. Data: name of the data set; empty for the task's first. Against: what differs in the
    other run, whose estimate the scene shows too (``Selection.against``); empty without one. Beside: whether its maps
    are wanted too.
    """

    serial: int
    task: str
    filter: str
    episode: int
    step: int
    angle: float | None
    size: int
    faults: Faults = WHOLE
    scene: bool = True
    data: str = ""
    against: str = ""
    beside: bool = False


LAYERS = ("replay", "objects", "estimates", "contours", "particles", "force", "map", "camera")
"""What the 3D scene is made of: each can be hidden."""


@dataclass(frozen=True)
class Look:
    """How a 3D scene is looked at.

    Hidden: of ``LAYERS``. Ground: the maps' layer that lies on the floor, ``fused`` where the maps do not have it.
    Height: the map on the floor, or under the belief, which is drawn above the object. Tint: particles by their weight,
    or by the share of each modality in it. Scale, range, colours: as the page's maps.
    """

    hidden: frozenset[str] = frozenset()
    ground: str = "fused"
    height: Literal["floor", "belief"] = "floor"
    tint: Literal["weight", "share"] = "weight"
    scale: Literal["normalised", "log"] = "normalised"
    range: Literal["own", "same"] = "own"
    colours: Literal["viridis", "cividis"] = "viridis"


def look(message: dict[str, Any]) -> Look:
    """Reads a ``look`` message. Raises BadInput for what cannot be hidden, and for an unknown choice."""
    given: dict[str, Any] = {"hidden": frozenset()}
    hidden = message.get("hidden", [])
    if not isinstance(hidden, list):
        raise BadInput(f"look's 'hidden' is a list of layers; got {hidden!r}.")
    for name in hidden:
        if name not in LAYERS:
            raise one_of("layer of the scene", name, LAYERS)
    given["hidden"] = frozenset(hidden)
    for key, kind in get_type_hints(Look).items():
        if key == "hidden" or key not in message:
            continue
        if not isinstance(message[key], str):
            raise BadInput(f"look's {key!r} is text; got {message[key]!r}.")
        if get_args(kind) and message[key] not in get_args(kind):
            raise one_of(f"look's {key!r}", message[key], get_args(kind))
        given[key] = message[key]
    return Look(**given)


VIEWPOINTS = ("first", "above", "camera")
"""Where one may stand in a scene: as at first, over the belief, and where the camera that took the pictures is seen."""


def viewpoint(message: dict[str, Any]) -> str:
    """Reads a ``stand`` message. Raises BadInput for a place that does not exist."""
    if message.get("at") not in VIEWPOINTS:
        raise one_of("viewpoint", str(message.get("at")), VIEWPOINTS)
    return str(message["at"])


def layers(task: Task, trace: Trace, no_maps: str | None) -> list[str]:
    """Those of ``LAYERS`` that the scene of a trace has."""
    there = {
        "replay": task.replay is not None and trace.episode.qpos.shape[1] > 0,
        "objects": task.ghost is not None,
        "estimates": True,
        "contours": trace.has_covariance,
        "particles": trace.particles is not None and trace.log_weights is not None,
        "force": trace.episode.observations.keys() >= set(SENSORS),
        "map": no_maps is None,
        "camera": task.camera is not None and pictures(trace) is not None,
    }
    return [layer for layer in LAYERS if there[layer]]


def cursor(message: dict[str, Any]) -> Cursor:
    """Reads a ``cursor`` message. Raises BadInput where a field is missing, of another type, or out of its range."""
    integers = {key: _integer(message, key) for key in ("serial", "episode", "step")}
    for key in ("task", "filter"):
        if not isinstance(message.get(key), str):
            raise BadInput(f"cursor needs {key!r}, a name; got {message.get(key)!r}.")
    angle = message.get("angle")
    if angle is not None and not _is_number(angle):
        raise BadInput(f"cursor's 'angle' is a number of radians or null; got {angle!r}.")
    faults, data, against = (message.get(key, "") for key in ("faults", "data", "against"))
    for key, text in (("faults", faults), ("data", data), ("against", against)):
        if not isinstance(text, str):
            raise BadInput(f"cursor's {key!r} is text; got {text!r}.")
    size = message.get("size", MAP_SIZES[0])
    if type(size) is not int or size not in MAP_SIZES:
        raise BadInput(f"cursor's 'size' is {' or '.join(map(str, MAP_SIZES))}; got {size!r}.")
    scene, beside = message.get("scene", True), message.get("beside", False)
    for key, flag in (("scene", scene), ("beside", beside)):
        if not isinstance(flag, bool):
            raise BadInput(f"cursor's {key!r} is true or false; got {flag!r}.")
    return Cursor(
        task=message["task"],
        filter=message["filter"],
        angle=angle,
        size=size,
        faults=Faults.parse(faults),
        scene=scene,
        data=data,
        against=against,
        beside=beside,
        **integers,
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST_ANGLE


def _integer(message: dict[str, Any], key: str) -> int:
    value = message.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise BadInput(f"cursor needs {key!r}, an integer from 0; got {value!r}.")
    return value


def columns(trace: Trace) -> tuple[list[dict[str, Any]], bytes]:
    """A trace's numbers for the charts, time first.

    Returns:
        descriptions ``{"name", "shape", "offset"}`` (offset in bytes) and one buffer of float32 that they point into.
    """
    innovation = innovations(trace)
    arrays: dict[str, NDArray[Any] | None] = {
        "truth": trace.episode.states,
        "estimate_mean": trace.estimate_mean,
        "estimate_sigma": _sigma(trace.estimate_covariance) if trace.has_covariance else None,
        "modality_mean": trace.modality_mean if trace.alone else None,
        "modality_sigma": _sigma(trace.modality_covariance) if trace.alone else None,
        "nees": measures.nees(trace) if trace.has_covariance else None,
        "innovation": None if innovation is None else innovation[0],
        "innovation_sigma": None if innovation is None else _sigma(innovation[1]),
        "weights": trace.weights,
        "acting": trace.acting,
        "contact": trace.episode.contact,
        "effective_sample_size": trace.effective_sample_size,
    }
    arrays |= {key: trace.episode.observations.get(key) for key in SENSORS}
    described: list[dict[str, Any]] = []
    buffers: list[bytes] = []
    offset = 0
    for name, array in arrays.items():
        if array is not None:
            described.append({"name": name, "shape": list(array.shape), "offset": offset})
            buffers.append(np.ascontiguousarray(array, dtype="<f4").tobytes())
            offset += len(buffers[-1])
    return described, b"".join(buffers)


def pictures(trace: Trace) -> NDArray[np.uint8] | None:
    """(T, H, W): the first of the observations that is a picture, as the filter saw it; None where none is."""
    seen = trace.episode.observations.values()
    return next((array for array in seen if array.ndim == 3 and array.dtype == np.uint8), None)


def header(trace: Trace, described: list[dict[str, Any]], task: Task, no_maps: str | None) -> dict[str, Any]:
    """What the page must know of a trace before it reads its columns. No_maps: why there are none, where so."""
    shown = pictures(trace)
    components = [{"name": c.name, "unit": c.unit} for c in task.components]
    return {
        "steps": len(trace),
        "dt": trace.episode.dt,
        "kind": trace.kind,
        "filter": trace.filter,
        "episode": trace.episode_index,
        "components": components,
        "modalities": list(trace.modalities),
        "weight_width": 0 if trace.weights is None else trace.weights.shape[-1],
        "checkpoint_hash": trace.checkpoint_hash,
        "data_hash": trace.data_hash,
        "seed": trace.seed,
        "faults": str(trace.faults),
        "settings": dict(trace.settings),
        "nees_bounds": nees_bounds(len(components), 1) if trace.has_covariance else None,
        "no_maps": no_maps,
        "pictures": None if shown is None else list(shown.shape[1:]),
        "columns": described,
        "scene": layers(task, trace, no_maps),
    }


def closing(reason: str) -> str:
    """As much of it as fits the end of a WebSocket: 123 bytes."""
    return reason.encode()[:123].decode(errors="ignore")


def _sigma(covariance: NDArray[Any]) -> NDArray[Any]:
    """(..., n, n) -> (..., n): standard deviations."""
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))

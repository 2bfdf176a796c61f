"""How likelihood maps travel to the page (docs/api.md): their numbers, the particles beneath them, and their cells."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import Task
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.maps.statistics import measure_maps
from beliefscope.inspect.trace import Trace

LOG_RANGE = 64.0
"""nats below its peak that a layer is told apart: e^-64 is nothing. What lies deeper travels as if it lay so deep."""

STEPS = 2**16 - 1
"""Of a cell's uint16: a thousandth of a nat each over the whole range."""

NUMBERS = (
    "log_peak",
    "truth",
    "entropy",
    "area50",
    "area95",
    "axis",
    "elongation",
    "off_line",
    "divergence",
    "overlap",
)


@dataclass(frozen=True)
class WiredMaps:
    """Maps of one step, and all of their message but for whose cursor it answers.

    Attributes:
        description: the message's JSON header but for its first three entries. content: what follows it.
    """

    maps: LikelihoodMap
    description: str
    content: bytes

    @property
    def nbytes(self) -> int:
        """In memory, about."""
        return self.maps.log_likelihood.nbytes + len(self.content)

    def message(self, serial: int, other: bool = False) -> bytes:
        """Header's length, JSON header, padding to a multiple of 4, content. Other: whether of the other run."""
        first = json.dumps({"type": "maps", "serial": serial, "other": other})
        text = f"{first[:-1]}, {self.description[1:]}".encode()
        return len(text).to_bytes(4, "little") + text + b"\0" * (-len(text) % 4) + self.content


def wire_maps(task: Task, trace: Trace, index: int, maps: LikelihoodMap) -> WiredMaps:
    """The content is float32 particles, then the layers as uint16.

    Index: of the maps' step in the trace, which may be a part of a run.
    """
    effector = trace.episode.observations.get("effector_position")
    cells, log_max, log_range = quantised(maps.log_likelihood)
    cloud = particles(trace, index, task)
    measured = measure_maps([replace(maps, step=index)], trace)
    # Without a truth the maps are laid around the estimate: what is likely there is not what is likely at the truth.
    unknown = {"truth": [None] * len(maps.layers)} if np.isnan(trace.episode.states[index]).any() else {}
    description = {
        "step": maps.step,
        "size": len(maps.offsets_x),
        "angle": None if math.isnan(maps.angle) else float(maps.angle),
        "layers": list(maps.layers),
        "half_width": float(-maps.offsets_x[0] + 0.5 * (maps.offsets_x[1] - maps.offsets_x[0])),
        "centre": maps.centre.tolist(),
        "truth": _json(trace.episode.states[index]),
        "estimate": _json(trace.estimate_mean[index]),
        "log_max": _json(log_max),
        "log_range": _json(log_range),
        "peak": maps.peaks().tolist(),
        "effector": None if effector is None else effector[index, :2].tolist(),
        "numbers": {name: _json(getattr(measured, name)[0]) for name in NUMBERS} | unknown,
        "particles": 0 if cloud is None else len(cloud[0]),
    }
    floats = [] if cloud is None else [np.ascontiguousarray(part, dtype="<f4").tobytes() for part in cloud]
    return WiredMaps(maps, json.dumps(description), b"".join([*floats, cells.astype("<u2").tobytes()]))


def quantised(log: NDArray[np.float32]) -> tuple[NDArray[np.uint16], NDArray[np.float32], NDArray[np.float32]]:
    """Layers (L, S, S) of log-likelihood as q, with ``log = log_max + log_range * (q / 65535 - 1)``.

    Returns:
        q (L, S, S), log_max (L,), log_range (L,) at most ``LOG_RANGE``: there q = 0 means so little or less.
    """
    top = log.max(axis=(1, 2), keepdims=True)
    span = np.clip(top - log.min(axis=(1, 2), keepdims=True), 1e-6, LOG_RANGE)
    q = np.rint((np.maximum(log - top, -span) / span + 1.0) * STEPS).astype(np.uint16)
    return q, top[:, 0, 0], span[:, 0, 0]


def particles(trace: Trace, step: int, task: Task) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """(M, 2) m, the predicted particles' positions on the map; (L, M) their weights as each layer sets them, sum 1.

    None for a filter without particles, or whose layers' weights are not known.
    """
    if trace.particles is None or trace.log_likelihood is None or trace.prior_log_weights is None:
        return None
    assert trace.log_weights is not None
    alone = trace.prior_log_weights[step] + trace.log_likelihood[step]
    log = np.concatenate([alone, trace.log_weights[step][None]])
    weights = np.exp(log - np.logaddexp.reduce(log, axis=1, keepdims=True))
    return trace.particles[step][:, list(task.map_indices)], weights


def _json(array: NDArray[Any]) -> Any:
    """Nested lists; JSON knows neither NaN nor infinity: null."""
    if array.ndim == 0:
        return float(array) if np.isfinite(array) else None
    return [_json(part) for part in array]

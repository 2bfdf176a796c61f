"""Binary encoding of likelihood maps (docs/api.md): statistics, particles and cells."""

import json
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.maps.map_statistics import measure_maps, particle_cloud
from beliefscope.inspect.maps.shape import SHAPES
from beliefscope.inspect.trace import Trace

LOG_RANGE = 64.0
"""nats below its peak; lower log-likelihoods of a layer are clipped (e^-64 is negligible)."""

LEVELS = 2**16 - 1
"""Largest uint16 of a cell; the resolution is a thousandth of a nat over the full range."""

NUMBERS = (
    "mean",
    "log_peak",
    "truth",
    "entropy",
    "area50",
    "area95",
    "axis",
    "elongation",
    "deviation",
    "ring_centre",
    "ring_radius",
    "ring_coverage",
    "divergence",
    "overlap",
)


@dataclass(frozen=True)
class EncodedMaps:
    """Maps of one step, and their message except for the fields that depend on the cursor.

    description: JSON header of the message without its first three entries. content: binary part. on_floor: whether the
    maps are over the position on the floor.
    """

    maps: LikelihoodMap
    on_floor: bool
    description: str
    content: bytes

    @property
    def nbytes(self) -> int:
        """Approximate size in memory."""
        return self.maps.log_likelihood.nbytes + len(self.content)

    def message(self, serial: int, other: bool = False) -> bytes:
        """Header length, JSON header, padding to a multiple of 4, content. other: of the comparison run."""
        first = json.dumps({"type": "maps", "serial": serial, "other": other})
        text = f"{first[:-1]}, {self.description[1:]}".encode()
        return len(text).to_bytes(4, "little") + text + b"\0" * (-len(text) % 4) + self.content


def encode_maps(trace: Trace, index: int, maps: LikelihoodMap) -> EncodedMaps:
    """Encode maps: float32 particles, then the layers as uint16.

    index: of the maps' step in the trace, which may be part of a run.
    """
    task, effector = trace.task, trace.episode.observations.get("effector_position")
    cells, log_max, log_range = quantise(maps.log_likelihood)
    cloud = particle_cloud(trace, index, maps.components)
    axes = [
        task.components[k].to_json() | {"half_width": float(-x[0] + 0.5 * (x[1] - x[0])), "index": k}  # SI
        for k, x in zip(maps.components, (maps.offsets_x, maps.offsets_y), strict=False)
    ]
    on_floor, same_unit = maps.components == task.floor, len(axes) == 2 and axes[0]["unit"] == axes[1]["unit"]
    statistics = measure_maps([replace(maps, step=index)], trace)
    # Without a true state the maps are centered on the estimate, whose log-likelihood is not the one at the truth.
    unknown = {"truth": [None] * len(maps.layers)} if np.isnan(trace.episode.states[index]).any() else {}
    if not same_unit:  # directions and circles have no meaning
        unknown |= {name: [None] * len(maps.layers) for name in ("axis", "elongation", "deviation", "ring_radius")}
    description = {
        "step": maps.step,
        "size": len(maps.offsets_x),
        "rows": len(maps.offsets_y),
        "quantity": maps.quantity,
        "rule": maps.rule,
        "angle": maps.angle,
        "layers": maps.layers,
        "axes": axes,
        "others": maps.others,
        "note": maps.note,
        "centre": maps.centre,
        "truth": trace.episode.states[index],
        "estimate": task.near(trace.estimate_mean[index], trace.episode.states[index]),
        "log_max": log_max,
        "log_range": log_range,
        "peak": maps.peaks(),
        "effector": effector[index, :2] if effector is not None and on_floor else None,
        "expected": statistics.expected[0],
        "shape": [SHAPES[shape] if same_unit else None for shape in statistics.shape[0]],
        "numbers": {name: getattr(statistics, name)[0] for name in NUMBERS} | unknown,
        "particles": 0 if cloud is None else len(cloud[0]),
    }
    floats = [] if cloud is None else [np.ascontiguousarray(part, dtype="<f4").tobytes() for part in cloud]
    content = b"".join([*floats, cells.astype("<u2").tobytes()])
    return EncodedMaps(maps, on_floor, json.dumps(as_json(description)), content)


def quantise(log: NDArray[np.float32]) -> tuple[NDArray[np.uint16], NDArray[np.float32], NDArray[np.float32]]:
    """Layers (L, R, S) of log-likelihood as q, with ``log = log_max + log_range * (q / 65535 - 1)``.

    Returns q (L, R, S), log_max (L,), log_range (L,) at most ``LOG_RANGE``: there q = 0 stands for all lower values.
    """
    top = log.max(axis=(1, 2), keepdims=True)
    span = np.clip(top - log.min(axis=(1, 2), keepdims=True), 1e-6, LOG_RANGE)
    q = np.rint((np.maximum(log - top, -span) / span + 1.0) * LEVELS).astype(np.uint16)
    return q, top[:, 0, 0], span[:, 0, 0]

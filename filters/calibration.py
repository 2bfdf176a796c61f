"""Calibration of a filter after training: factors on its covariances and radii of conformal regions, as JSON.

A calibration is fitted to held-out episodes (``inspect/calibrate.py``) and applied to the output of a filter, whose
estimates and recursion do not change.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json

FORMAT = 1
FUSED = "fused"

Array = NDArray[np.float64]
Covariance = TypeVar("Covariance", Tensor, NDArray[Any])


@dataclass(frozen=True)
class Layer:
    """Calibration of one estimate, at the level of its ``Calibration``.

    Attributes:
        scale: factor on the covariance; None without a covariance.
        ellipsoid: radius r of the region ``e^T S^-1 e <= r^2``, S the covariance as it is; None without a covariance.
        distances: ``position`` in m, and each angle in rad -> radius of the region around the estimate.
    """

    scale: float | None
    ellipsoid: float | None
    distances: Mapping[str, float]


@dataclass(frozen=True)
class Calibration:
    """Calibration of a filter, from R held-out episodes.

    Attributes:
        task, filter, checkpoint_hash, data_hash: origin.
        episodes: R. level: share of the steps of a new episode in each region, at least.
        layers: ``fused``, and each modality for its single-modality updates.
    """

    task: str
    filter: str
    checkpoint_hash: str
    data_hash: str
    episodes: int
    level: float
    layers: Mapping[str, Layer]

    def layer(self, name: str = FUSED) -> Layer:
        """Raises BadInput for an unknown name."""
        if name not in self.layers:
            raise unknown_name("layer of the calibration", name, self.layers)
        return self.layers[name]

    def covariance(self, covariance: Covariance, layer: str = FUSED) -> Covariance:
        """Covariances (..., n, n), in any units, multiplied by the layer's factor. Raises BadInput without a factor."""
        scale = self.layer(layer).scale
        if scale is None:
            raise BadInput(f"filter {self.filter!r} has no covariance of layer {layer!r} that could be scaled")
        return covariance * scale

    def wrap(self, module: nn.Module) -> Calibrated:
        """An external filter that returns calibrated covariances."""
        return Calibrated(module, self)

    def to_json(self) -> dict[str, Any]:
        return {"format": FORMAT, **asdict(self)}

    @classmethod
    def from_json(cls, document: Any) -> Calibration:
        """Inverse of ``to_json``. Raises BadInput for another document."""
        if not isinstance(document, Mapping) or document.get("format") != FORMAT:
            raise BadInput(f"it is not a calibration of format {FORMAT}")
        values = {key: document.get(key) for key in cls.__dataclass_fields__}
        for key in ("task", "filter", "checkpoint_hash", "data_hash"):
            if not isinstance(values[key], str):
                raise BadInput(f"{key} is {values[key]!r}, not a text")
        level, layers = values["level"], values["layers"]
        if not _is_number(level) or not 0.0 < level < 1.0:
            raise BadInput(f"level is {level!r}, not a number between 0 and 1")
        if not isinstance(values["episodes"], int) or not isinstance(layers, Mapping):
            raise BadInput("episodes must be an integer, and layers an object")
        return cls(**values | {"layers": {name: _layer(name, layer) for name, layer in layers.items()}})


class Calibrated(nn.Module):
    """External filter (docs/own_filter.md) whose covariances are multiplied by the factors of a calibration.

    Only returned values change; the module's belief, and so its estimates, are its own.
    """

    def __init__(self, module: nn.Module, calibration: Calibration) -> None:
        super().__init__()
        self.module, self.calibration, self.task = module, calibration, calibration.task
        if hasattr(module, "initialize_beliefs"):  # a module that runs step by step
            self.initialize_beliefs = module.initialize_beliefs

    def forward(self, *inputs: Any, **named: Any) -> Any:
        """The module's output: a mean, a pair of mean and covariance, or a dictionary (docs/own_filter.md)."""
        output = self.module(*inputs, **named)
        if isinstance(output, tuple) and len(output) == 2:
            return output[0], self.calibration.covariance(output[1])
        if not isinstance(output, Mapping):
            return output
        values = dict(output)
        if "estimate_covariance" in values:
            values["estimate_covariance"] = self.calibration.covariance(values["estimate_covariance"])
        if "modality_covariance" in values:
            values["modality_covariance"] = self._modality_covariance(values["modality_covariance"])
        return values

    def _modality_covariance(self, covariance: Tensor) -> Tensor:
        """Covariances (N, K, n, n) multiplied by the factors of the K modalities."""
        scales = [layer.scale for name, layer in self.calibration.layers.items() if name != FUSED]
        if len(scales) != covariance.shape[-3] or None in scales:
            raise BadInput(f"the calibration has factors of {len(scales)} modalities, not of {covariance.shape[-3]}")
        return covariance * covariance.new_tensor(scales)[:, None, None]


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Writes the JSON file atomically. Raises BadInput if it cannot be written."""
    write_atomically(path, (json.dumps(calibration.to_json(), indent=1) + "\n").encode())


def load_calibration(path: str | Path) -> Calibration:
    """Reads a file of ``save_calibration``. Raises BadInput, in one line, for any other file."""
    try:
        return Calibration.from_json(read_json(Path(path).read_bytes()))
    except OSError as error:
        raise BadInput(f"cannot read calibration {str(path)!r}: {error.strerror or error}") from None
    except ValueError as error:  # includes BadInput
        raise BadInput(f"calibration {str(path)!r}: {error}") from None


def conformal_radius(scores: Sequence[Array], level: float) -> float:
    """Smallest radius whose region has at least a share ``level`` of the steps of a new episode, in expectation.

    The smallest x with ``sum_r 1 / (R + 1) share_r(score <= x) >= level``: each of the R episodes has equal weight, and
    the new one the rest. Valid for any dependence within episodes that are exchangeable (Lee, Barber and Willett,
    Distribution-free inference with hierarchical data, 2023). Infinite for too few episodes, ``R / (R + 1) < level``.

    Args:
        scores: (T_r,) of each episode.
    """
    values = np.concatenate(scores)
    weights = np.concatenate([np.full(len(s), 1.0 / len(s)) for s in scores]) / (len(scores) + 1.0)
    order = np.argsort(values, kind="stable")
    at = int(np.searchsorted(np.cumsum(weights[order]), level - 1e-12))
    return float(values[order][at]) if at < len(values) else math.inf


def _layer(name: str, value: Any) -> Layer:
    """Raises BadInput for other values than positive numbers, or None."""
    fields = dict(value) if isinstance(value, Mapping) else {}
    distances = fields.get("distances")
    numbers = [
        fields.get("scale"),
        fields.get("ellipsoid"),
        *(distances.values() if isinstance(distances, dict) else ()),
    ]
    valid = set(fields) == {"scale", "ellipsoid", "distances"} and isinstance(distances, dict)
    if not valid or not all(v is None or (_is_number(v) and 0.0 < v < math.inf) for v in numbers):
        raise BadInput(f"layer {name!r} is not an object with scale, ellipsoid and distances above 0")
    return Layer(**fields)


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)

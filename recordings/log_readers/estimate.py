"""Recorded estimates: means, covariances and particles from the columns of a log."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets import rotations
from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers.arrays import Columns
from beliefscope.recordings.log_readers.column_map import (
    PLANAR_ELEMENTS,
    QUATERNION,
    ROTATIONS,
    ColumnMap,
    MeanReferences,
    References,
    StateColumn,
    base_name,
    listed,
)
from beliefscope.recordings.log_readers.columns import joined

Array = NDArray[np.float64]


def estimate_values(columns: Columns, mapping: ColumnMap) -> dict[str, Array]:
    """(T, ...) values of the recorded estimate by the names of a trace, SI units.

    Raises BadInput for columns that the log lacks, or whose number does not fit the state.
    """
    estimate, factors, n = mapping.estimate, mapping.factors, len(mapping.components)
    values: dict[str, Array] = {}
    if "mean" in estimate:
        mean = _mean(columns, estimate["mean"], [*mapping.state.values()])
        if mean.shape[1] != n:
            is_rotation = any(entry.unit in (QUATERNION, *ROTATIONS) for entry in mapping.state.values())
            hint = "; a quaternion is one entry, a column or a list of four" if is_rotation else ""
            raise BadInput(f"mean of [estimate] has {mean.shape[1]} columns, expected {n}: {_names(mapping)}{hint}")
        values["estimate_mean"] = mean * factors
    if "covariance" in estimate:
        covariance = _covariance(columns, estimate["covariance"], n)
        values["estimate_covariance"] = covariance.reshape(-1, n, n) * factors * factors[:, None]
        _check_not_negative(covariance[:, :: n + 1], "covariance of [estimate] has the variance")
    elif "std" in estimate:
        std = joined(columns, estimate["std"], "estimate")
        if std.shape[1] != n:
            raise BadInput(f"std of [estimate] has {std.shape[1]} columns, expected {n}: {_names(mapping)}")
        _check_not_negative(std, "std of [estimate] has the value")  # squares would hide a sign
        with np.errstate(invalid="ignore"):  # infinite ones are reported with their row
            values["estimate_covariance"] = np.square(std * factors)[:, :, None] * np.eye(n)
    if "particles" in estimate:
        values["particles"] = _particles(columns, estimate["particles"], n) * factors
        values["log_weights"] = np.full(values["particles"].shape[:2], -np.log(values["particles"].shape[1]))
        values.setdefault("estimate_mean", values["particles"].mean(axis=1))
        values.setdefault("estimate_covariance", _sample_covariance(values["particles"]))
    if weights := estimate.get("weights"):
        values["weights"] = joined(columns, list(weights.values()), "weights")[:, :, None]
    return values


def _check_not_negative(values: Array, what: str) -> None:
    """Raise BadInput for the first row of (T, d) values with a negative one."""
    if (negative := values < 0.0).any():
        row = int(np.argwhere(negative)[0][0])
        raise BadInput(f"{what} {values[negative][0]:g} in row {row}, expected zero or more")


def _names(mapping: ColumnMap) -> str:
    return ", ".join(component.name for component in mapping.components)


def _mean(columns: Columns, references: MeanReferences, state: list[StateColumn]) -> Array:
    """(T, d) means in the units of the state; quaternions, in one column or a list of four, as angles."""
    references = [references] if isinstance(references, str) and len(state) == 1 else references
    if isinstance(references, str) or len(references) != len(state):
        return joined(columns, listed(references), "estimate")
    pairs = zip(references, state, strict=True)
    return np.concatenate([scalar(columns, name, s.unit, "estimate") for name, s in pairs], axis=1)


def _covariance(columns: Columns, references: References, n: int) -> Array:
    """(T, n n): elements of larger square matrices are counted row by row, as in a message of ROS."""
    matrices = {
        name: values.reshape(len(values), -1)
        for name in map(base_name, listed(references))
        if (values := columns.get(name)) is not None and values.ndim == 3 and n < values.shape[1] == values.shape[2]
    }
    covariance = joined({**columns, **matrices}, references, "estimate")
    if (size := covariance.shape[1]) != n * n:
        hint = f"; {PLANAR_ELEMENTS} are those of x, y and yaw in a message of ROS" if (size, n) == (36, 3) else ""
        raise BadInput(f"covariance of [estimate] has {size} numbers per row, expected {n * n}{hint}")
    if not covariance.any():
        raise BadInput("covariance of [estimate] is zero in all rows; remove it from the map if it is unknown")
    return covariance


def _particles(columns: Columns, references: References, n: int) -> Array:
    """(T, M, n): from a column with M n numbers per row, or a column with M numbers for each component."""
    if isinstance(references, list) and len(references) == n:
        parts = [joined(columns, name, "estimate") for name in references]
        if len({part.shape for part in parts}) == 1:
            return np.stack(parts, axis=-1)
    particles = joined(columns, references, "estimate")
    if particles.shape[1] % n:
        raise BadInput(f"particles of [estimate] have {particles.shape[1]} numbers per row, not a multiple of {n}")
    return particles.reshape(len(particles), -1, n)


def scalar(columns: Columns, references: References, unit: str, purpose: str) -> Array:
    """(T, d) values of columns; of a quaternion of any norm, its angle about z (T, 1) or its vector (T, 3), rad.

    Raises BadInput as ``joined``, and for a quaternion of norm 0 or without four columns.
    """
    values = joined(columns, references, purpose)
    if unit in ROTATIONS:
        if values.shape[1] != 4:
            raise BadInput(f"{purpose} has a quaternion of {values.shape[1]} columns, expected 4")
        norm = np.linalg.norm(values, axis=1, keepdims=True)
        if len(zero := np.flatnonzero(norm == 0.0)):
            raise BadInput(f"{purpose} has a quaternion of norm 0 in row {zero[0]}")
        return rotations.to_vector((values / norm)[:, ROTATIONS[unit]])
    if unit != QUATERNION or values.shape[1] != 4:
        return values
    x, y, z, w = values.T
    with np.errstate(over="ignore", invalid="ignore"):  # no rotation; NaN is reported with its place
        return np.arctan2(2.0 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)[:, None]


def _sample_covariance(ensemble: Array) -> Array:
    """(T, n, n): unbiased covariance of the members (T, M, n)."""
    centred = ensemble - ensemble.mean(axis=1, keepdims=True)
    return np.einsum("tmi,tmj->tij", centred, centred) / max(ensemble.shape[1] - 1, 1)

"""Recorded innovations of the measurements, their covariances and gates, from the columns of a log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.text import plural
from beliefscope.recordings.log_readers.arrays import Columns
from beliefscope.recordings.log_readers.column_map import ColumnMap, InnovationColumns, base_name, internal_units
from beliefscope.recordings.log_readers.columns import column, joined
from beliefscope.recordings.log_readers.messages import NEW

Array = NDArray[np.float64]


def innovation_values(columns: Columns, mapping: ColumnMap, modalities: Sequence[str]) -> dict[str, Array]:
    """(T, K, ...) values by the names of a trace, NaN where there is no measurement; empty without innovations.

    Raises BadInput for a modality that is not among those of the fusion weights, and for columns of another size.
    """
    if not mapping.innovations:
        return {}
    for name in mapping.innovations:
        if name not in modalities:
            raise BadInput(f"modality {name!r} of [innovations] has no fusion weight, unlike {', '.join(modalities)}")
    parts = {name: _of_modality(columns, name, entry) for name, entry in mapping.innovations.items()}
    steps, size = len(next(iter(parts.values()))[0]), max(nu.shape[1] for nu, _, _ in parts.values())
    k = len(modalities)
    innovation, covariance = np.full((steps, k, size), np.nan), np.full((steps, k, size, size), np.nan)
    accepted = np.full((steps, k), np.nan)
    for name, (nu, s, used) in parts.items():
        at, m = list(modalities).index(name), nu.shape[1]
        innovation[:, at, :m], covariance[:, at, :m, :m], accepted[:, at] = nu, s, used
    values = {"innovation": innovation, "innovation_covariance": covariance}
    return values | ({"accepted": accepted} if np.isfinite(accepted).any() else {})


def _of_modality(columns: Columns, name: str, entry: InnovationColumns) -> tuple[Array, Array, Array]:
    """Innovations (T, m), their covariance (T, m, m), and whether they were used (T,)."""
    what = f"innovations of {name!r}"
    nu = joined(columns, entry.innovation, what)
    m = nu.shape[1]
    spread = joined(columns, entry.covariance or entry.std, what)
    if spread.shape[1] != (expected := m * m if entry.covariance else m):
        key = "covariance" if entry.covariance else "std"
        raise BadInput(f"{key} of the {what} has {plural(spread.shape[1], 'number')} per row, expected {expected}")
    s = spread.reshape(-1, m, m) if entry.covariance else np.square(spread)[:, :, None] * np.eye(m)
    factors = np.array([factor for _, factor in internal_units(entry.unit, m, what)])
    used: Array = column(columns, entry.accepted, what) if entry.accepted else np.full(len(nu), np.nan)
    if used.shape != (len(nu),):
        raise BadInput(f"accepted of the {what} has shape {used.shape}, expected {(len(nu),)}")
    present = np.isfinite(nu).all(1) & np.isfinite(s).all((1, 2))
    new: list[NDArray[Any]] = [columns[key] for ref in entry.references if (key := NEW + base_name(ref)) in columns]
    present &= np.any(new, axis=0) if new else True
    absent = ~present
    nu, s, used = nu * factors, s * factors * factors[:, None], np.where(np.isnan(used), used, used != 0.0)
    nu[absent], s[absent], used[absent] = np.nan, np.nan, np.nan
    return nu, s, used

"""Validation results of a fine-tuning run as curves and as text."""

from __future__ import annotations

from beliefscope.filters.finetuning.loop import Validation


def curve_values(validation: Validation) -> dict[str, float]:
    """Metrics named ``slice/measure``, and ``loss`` after the first validation."""
    values = {} if validation.loss is None else {"loss": validation.loss}
    for name, metrics in validation.slices.items():
        measures = {**metrics["rmse"], **{key: metrics[key] for key in ("nll", "nees", "coverage95")}}
        values |= {f"{name}/{key}": value for key, value in measures.items() if value is not None}
    return values


def error_summary(first: Validation, last: Validation) -> str:
    """Position error by slice: ``clean 0.34 cm, blackout 0.95 3.14 -> 1.20 cm``."""
    parts = []
    for name, metrics in last.slices.items():
        before, after = first.slices[name]["rmse"]["position_cm"], metrics["rmse"]["position_cm"]
        parts.append(f"{name} {before:.2f} cm" if before == after else f"{name} {before:.2f} -> {after:.2f} cm")
    return ", ".join(parts)

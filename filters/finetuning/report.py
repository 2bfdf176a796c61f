"""Modules of a filter and validation results of a fine-tuning run as curves, tables and text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from beliefscope.datasets.task import MainError
from beliefscope.datasets.text import percent
from beliefscope.filters.finetuning.loop import Validation
from beliefscope.filters.finetuning.module_selection import Node, module_change
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.success import BELIEF


def curve_values(validation: Validation) -> dict[str, float]:
    """Metrics named ``slice/measure``, and ``loss`` after the first validation."""
    values = {} if validation.loss is None else {"loss": validation.loss}
    for name, metrics in validation.slices.items():
        measures = {**metrics["rmse"], **{key: metrics[key] for key in ("nll", "nees", "coverage95")}}
        values |= {f"{name}/{key}": value for key, value in measures.items() if value is not None}
    return values


def error_summary(main: MainError, first: Validation, last: Validation) -> str:
    """Main error by slice: ``validation windows: clean 0.34 cm, blackout 0.95 3.14 -> 1.20 cm``."""
    parts = []
    key, unit = main.key, f" {main.unit}".rstrip()
    for name, metrics in last.slices.items():
        before, after = first.slices[name]["rmse"][key], metrics["rmse"][key]
        parts.append(f"{name} {before:.2f}{unit}" if before == after else f"{name} {before:.2f} -> {after:.2f}{unit}")
    return f"validation windows: {', '.join(parts)}"


def held_out_rows(record: Mapping[str, Any]) -> list[list[str | float | None]]:
    """Errors on windows of held-out episodes in a training record, one row per slice and measure.

    Returns:
        ``[name, before, after, change]``: the change in percent for errors, as a difference for nll and nees.
    """
    before, after = (
        {name: {**metrics["rmse"], **metrics} for name, metrics in record["held_out"][state].items()}
        for state in ("before", "after")
    )
    keys = [*next(iter(before.values()))["rmse"], *BELIEF]
    return [
        [
            f"{name}: {BELIEF.get(key, key)}",
            values[key],
            after[name][key],
            _difference(values[key], after[name][key], key),
        ]
        for name, values in before.items()
        for key in keys
    ]


def _difference(before: float | None, after: float | None, key: str) -> str | None:
    if before is None or after is None:
        return None
    return f"{after - before:+z.2f}" if key in BELIEF or not before else percent(after / before - 1, "+.0f")


def module_table(
    nodes: Iterable[Node], changes: Mapping[str, Sequence[float]], depth: int
) -> tuple[list[str], list[list[str | int | float | None]]]:
    """Columns and rows of the modules down to a depth.

    Args:
        changes: as for ``module_change``; without any, the table has no columns of gradients and changes.
    """
    columns = ["module", "class", "parameters", "state", *(["gradient", "change"] if changes else []), "purpose"]
    rows = []
    for node in nodes:
        if node.depth <= depth:
            label = "  " * node.depth + (node.name.rpartition(".")[2] or "(filter)")
            size = module_change(node.name, changes)
            sizes = [size["gradient"] or None, percent(size["change"], ".2g") if size["change"] else None]
            count = node.parameters or None
            rows.append([label, node.kind, count, node.state, *(sizes if changes else []), node.description])
    return columns, rows


def training_summary(record: Mapping[str, Any]) -> str:
    """Base checkpoint, best step and time, and whether the weights have changed."""
    text = (
        f"{record['base']['name']}, fine-tuned from {record['base']['hash'][:12]}, best validation at step "
        f"{record['best_step']} of {record['steps']}, {record['seconds']:.0f} s"
    )
    return "\n".join(filter(None, (text, no_change(record))))


def no_change(record: Mapping[str, Any]) -> str:
    """Advice if no validation improved on the base checkpoint, whose weights are kept then; else an empty text."""
    if record["best_step"] or record.get("noise_factor", 1.0) != 1.0:
        return ""
    rate = float(FineTune.from_json(record["base"]["settings"]).rate)
    return (
        "No change: the base checkpoint was best. Try a data slice on which this filter fails (beliefscope failures), "
        f"other modules (noise-only, heads-only, all), or a learning rate other than {rate:g}."
    )

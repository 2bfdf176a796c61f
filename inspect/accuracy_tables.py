"""Tables of the accuracy of a filter, its baselines and its modalities."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from beliefscope.datasets.task import display_name
from beliefscope.filters.evaluate import CONSISTENCY, STANDALONE, STAY, UPDATE
from beliefscope.inspect.diagnostics.views import Table

LABELS = {
    "rmse": "",
    "rmse_from_step_0": ", from step 0",
    "rmse_before_contact": ", before first contact",
    "rmse_after_contact": ", after first contact",
}
"""Key of the metrics -> label of its rows."""


def accuracy_tables(title: str, metrics: Mapping[str, Any]) -> list[Table]:
    """The metrics of a filter and its baselines, a row for each measure; then those of its modalities, if any.

    Baselines that the filter cannot run have no column. Without steps that the errors omit, those from step 0 are the
    same and have no rows.

    metrics: of ``filters.evaluate.Metrics.to_dict``.
    """
    baselines = {name: baseline for name, baseline in metrics["baselines"].items() if baseline}
    columns = [metrics, *baselines.values()]
    rows = [
        (f"rmse {name}{label}", *(_number(column.get(key, {}).get(name)) for column in columns))
        for key, label in LABELS.items()
        if key == "rmse" or metrics.get(key) != metrics["rmse"]
        for name in metrics.get(key, {})
    ]
    rows += [(label, _number(metrics[name]), *[""] * len(baselines)) for name, label in CONSISTENCY.items()]
    tables = [Table(title, ("measure", "filter", *baselines), rows, _start_note(metrics))]
    errors = {
        label.format(name): (metrics[key][name] or {}).get("rmse", {})
        for name in metrics.get("standalone", {})
        for key, label in (("updates", UPDATE), ("standalone", STANDALONE))
        if name in metrics.get(key, {})
    }
    if errors:
        rows = [(f"rmse {name}", *(_number(rmse.get(name)) for rmse in errors.values())) for name in metrics["rmse"]]
        failing = [name for name, alone in metrics["standalone"].items() if alone is None]
        note = f"The filter fails with {' and with '.join(map(display_name, failing))} only." if failing else ""
        tables.append(Table("Modalities", ("measure", *errors), rows, note))
    return tables


def _start_note(metrics: Mapping[str, Any]) -> str:
    """Names the errors that are no smaller than those of the start; empty without any."""
    stay = (metrics["baselines"].get(STAY) or {}).get("rmse", {})
    names = [name for name, value in metrics["rmse"].items() if name in stay and value >= stay[name]]
    if not names:
        return ""
    return (
        f"No better than {STAY}: rmse {', '.join(names)}. For a state that hardly moves, a start at the true state "
        "hides the errors of a filter that keeps it; --start-offset starts elsewhere."
    )


def _number(value: float | None) -> str | None:
    """Two decimals, or three significant digits of a smaller value, such as an error in rad/s."""
    if value is None:
        return None
    return f"{value:z8.2f}" if value == 0.0 or abs(value) >= 0.1 else f"{value:z8.3g}"

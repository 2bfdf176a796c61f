"""Verdict on the success criterion of a fine-tuning run, from the comparison with its base checkpoint."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from beliefscope.datasets.task import Task
from beliefscope.datasets.text import percent, plural
from beliefscope.filters.finetuning.success import ERROR, Criterion
from beliefscope.inspect.compare.checkpoints import CheckpointComparison
from beliefscope.inspect.compare.effects import Difference

Outcome = Literal["met", "not met", "inconclusive"]


@dataclass(frozen=True)
class SliceChange:
    """Change of the criterion's measure in one slice.

    Attributes:
        slice: its name. before, after: in ``unit``, that of display.
        change, low, high: relative change with its 95 % interval over episodes; NaN for too few.
        limit: largest permitted change. outcome: whether it is kept.
    """

    slice: str
    before: float
    after: float
    unit: str
    change: float
    low: float
    high: float
    limit: float
    outcome: Outcome


@dataclass(frozen=True)
class Success:
    """Outcome of a fine-tuning run by its criterion.

    Attributes:
        criterion: as text. statement: in words. outcome: of all slices. verdict: the outcome in words.
        slices: that of the criterion first.
        not_excluded: names of the slices whose change is within the limit but whose interval extends beyond it, if the
            criterion is met: the episodes do not exclude a larger change there.
    """

    criterion: str
    statement: str
    outcome: Outcome
    verdict: str
    slices: tuple[SliceChange, ...]
    not_excluded: tuple[str, ...]


def judge(criterion: Criterion, comparison: CheckpointComparison, task: Task) -> Success:
    """Compare the changes of the criterion's measure with its limits.

    The improvement is met if its whole 95 % interval is beyond the limit, not met if the whole interval falls short of
    it. A regression elsewhere is within the limit if the estimate is; beyond it, the criterion is not met if the whole
    interval is, too. Everything else is inconclusive.
    """
    measure = task.main_error.name if criterion.measure == ERROR else criterion.measure
    by_slice = {d.slice: d for d in comparison.differences if d.measure == measure}
    target = by_slice.pop(criterion.slice, None)
    rows = [_change(target, -criterion.by, is_target=True)] if target else []
    rows += [_change(d, criterion.others) for d in by_slice.values()]
    outcomes = {row.outcome for row in rows}
    outcome: Outcome = "met"
    if "not met" in outcomes:
        outcome = "not met"
    elif "inconclusive" in outcomes or target is None:
        outcome = "inconclusive"
    not_excluded = tuple(row.slice for row in rows if row.high > row.limit) if outcome == "met" else ()
    verdict = _verdict(outcome, rows, target, not_excluded)
    return Success(str(criterion), criterion.sentence(task), outcome, verdict, tuple(rows), not_excluded)


def _change(difference: Difference, limit: float, is_target: bool = False) -> SliceChange:
    """The limit is kept if the change is within it, or of the slice to improve, its whole interval."""
    change, low, high = (math.expm1(min(x, 30.0)) for x in (difference.effect, difference.low, difference.high))
    largest = high if is_target else change
    outcome: Outcome = "met" if largest <= limit else "not met" if low > limit else "inconclusive"
    before, after, unit = difference.display
    return SliceChange(difference.slice, before, after, unit, change, low, high, limit, outcome)


def _verdict(
    outcome: Outcome, rows: Sequence[SliceChange], target: Difference | None, not_excluded: Sequence[str]
) -> str:
    """The outcome, the change in the criterion's slice, and those elsewhere."""
    head = {"met": "Met", "not met": "Not met", "inconclusive": "Inconclusive"}[outcome]
    if target is None:
        return f"{head}: the slice of the criterion has no step in the held-out episodes."
    first, *others = rows
    if not_excluded:
        limit = percent(others[0].limit, "+.6g")
        head += f"; {limit} not excluded in {', '.join(map(_title, not_excluded))}"
    text = f"{head}: {_description(first)}"
    advice = _advice(rows) if outcome == "inconclusive" else ""
    return f"{text}{_elsewhere(others)}.{advice}"


def _elsewhere(others: Sequence[SliceChange]) -> str:
    """The slices beyond their limit and the inconclusive ones; the largest change if there are none."""
    failed, undecided = ([row for row in others if row.outcome == outcome] for outcome in ("not met", "inconclusive"))
    worst = max(failed or undecided or others, key=lambda row: row.change, default=None)
    if worst is None:
        return ""
    label = "largest change elsewhere:"
    if failed or undecided:
        slices = failed or undecided
        label = "beyond the limit" if failed else "inconclusive"
        label += f" in {len(slices)} slices, most in" if len(slices) > 1 else ":"
    more = f"; inconclusive in {plural(len(undecided), 'more slice')}" if failed and undecided else ""
    return f"; {label} {_description(worst)}{more}"


def _advice(rows: Sequence[SliceChange]) -> str:
    """Why a criterion is inconclusive, and what would decide it."""
    *names, last = (_title(row.slice) for row in rows if row.outcome == "inconclusive")
    listed = f"{', '.join(names)} and {last}" if names else last
    return f" These held-out episodes are too few to decide {listed}: more of them (--data) narrow the 95 % interval."


def _description(row: SliceChange) -> str:
    before, after = (f"{value:#.3g}".rstrip(".") for value in (row.before, row.after))
    values = f"{before} to {after} {row.unit}".rstrip()
    interval = ""
    if not math.isnan(row.low):
        interval = f", 95 % interval {round(100 * row.low):+d} to {round(100 * row.high):+d} %"
    return f"{_title(row.slice)} {percent(row.change, '+.1f')} ({values}{interval})"


def _title(slice_name: str) -> str:
    """The name of a slice in a text: those of fault slices are identifiers, such as image_noise."""
    return slice_name.replace("_", " ")

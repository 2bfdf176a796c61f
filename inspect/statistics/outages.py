"""Outages of a sensor: when they occur, how the error develops in them and after them, and how long they last."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode, outages
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array, Mask
from beliefscope.inspect.trace import Trace

RECOVERED = 1.5
"""Ratio of the error to its median outside of outages at which an estimate has recovered."""

DURATIONS = (1.0, 10.0, 60.0, 600.0)
"""Limits of the classes of durations, s."""


@dataclass(frozen=True)
class DurationClass:
    """Outages that last longer than ``low`` and at most ``high``, s.

    Attributes:
        count, steps: number of outages, and share of their known steps of all.
        square: mean square distance in these steps, m². share: of the sum of squared distances of all steps.
    """

    low: float
    high: float
    count: int
    steps: float
    square: float
    share: float

    @property
    def text(self) -> str:
        """The durations: ``1 to 10``, or ``over 600``."""
        return f"over {self.low:g}" if math.isinf(self.high) else f"{self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Outages:
    """Outages of a sensor.

    A reading is missing if it is absent (``Task.masks``), NaN or a blank image, or the filter reports no innovation of
    the modality. An outage has at least ``MISSED`` times as many steps as the median interval between readings.

    Attributes:
        modality: of the sensor. count, steps: number of outages and of their steps. longest: in s.
        before, during, end: root mean square distance in the step before, in all steps of, and in the last step of an
            outage; m. before and end are NaN if unknown.
        share: of the sum of squared distances, for the share ``steps`` of all steps.
        recovery: median time from the end of an outage until the error is at most ``RECOVERED`` times its median
            outside of outages, s; NaN without an outage that ends early enough.
        unrecovered: number of outages after which it is not reached before the next one or the end.
        classes: outages by duration, shortest first, without empty classes.
    """

    modality: str
    count: int
    steps: float
    longest: float
    before: float
    during: float
    end: float
    share: float
    recovery: float
    unrecovered: int
    classes: tuple[DurationClass, ...]

    @property
    def dominant(self) -> DurationClass | None:
        """The outages over the largest of ``DURATIONS`` that have most of the squared error; None if there is none."""
        for number in reversed(range(len(self.classes))):
            rest = self.classes[number:]
            share, steps = sum(c.share for c in rest), sum(c.steps for c in rest)
            if share > 0.5 and rest[0].low:
                square = sum(c.square * c.steps for c in rest) / steps
                return DurationClass(rest[0].low, math.inf, sum(c.count for c in rest), steps, square, share)
        return None


def missing_steps(trace: Trace) -> dict[str, Mask]:
    """Modality -> (T,): outages, in which no observation of the modality has a reading, or the filter used none."""
    result = {}
    for name, keys in trace.task.modalities.items():
        lost = np.ones(len(trace), dtype=bool)
        for key in keys:
            lost &= without_reading(trace.episode, key)
        if trace.innovation is not None and name in trace.modalities:
            lost |= np.isnan(trace.innovation[:, trace.modalities.index(name)]).all(1)
        result[name] = outages(lost)
    return result


def without_reading(episode: Episode, key: str) -> Mask:
    """(T,): steps without a reading of an observation: absent by its mask, NaN, or a blank image."""
    absent = ~episode.present(key)
    readings = episode.observations.get(key)
    if readings is None:
        return absent
    flat = readings.reshape(len(episode), -1)
    if flat.dtype.kind == "f":
        return np.asarray(absent | np.isnan(flat).any(1))
    return np.asarray(absent | (flat.min(1) == flat.max(1))) if flat.shape[1] > 1 else absent


def outages_of(
    name: str, traces: Sequence[Trace], distance: Sequence[Array], missing: Sequence[Mask], counted: Sequence[Mask]
) -> Outages | None:
    """Statistics of the outages of a modality; None if there are none.

    Args:
        distance: (T,) m, error of each trace. missing: (T,) its outages. counted: (T,) its steps that count.
    """
    during = np.concatenate([d[m & k] for d, m, k in zip(distance, missing, counted, strict=True)])
    outside = np.concatenate([d[~m & k] for d, m, k in zip(distance, missing, counted, strict=True)])
    if not len(during) or not len(outside):
        return None
    limit = RECOVERED * float(np.median(outside))
    before, end, recoveries, unrecovered = [], [], [], 0
    lengths, steps, squares = [], [], []
    for trace, d, m, k in zip(traces, distance, missing, counted, strict=True):
        runs, durations = measures.intervals(m), trace.episode.durations
        for number, (a, b) in enumerate(runs):
            lengths.append(float(durations[a:b].sum()))
            steps.append(int(k[a:b].sum()))
            squares.append(float(np.square(d[a:b][k[a:b]]).sum()))
            end.append(d[b - 1])
            before += [d[a - 1]] if a else []
            after = d[b : runs[number + 1][0] if number + 1 < len(runs) else len(d)]
            if not len(after):
                continue
            reached = np.flatnonzero(after <= limit)
            if len(reached):
                recoveries.append(float(durations[b : b + reached[0]].sum()))
            else:
                unrecovered += 1
    total = float(np.square(np.concatenate([during, outside])).sum())
    count = len(during) + len(outside)
    return Outages(
        modality=name,
        count=len(lengths),
        steps=len(during) / count,
        longest=max(lengths),
        before=root_mean_square(before),
        during=root_mean_square(during),
        end=root_mean_square(end),
        share=float(np.square(during).sum()) / max(total, 1e-300),
        recovery=float(np.median(recoveries)) if recoveries else math.nan,
        unrecovered=unrecovered,
        classes=_classes(np.array(lengths), np.array(steps), np.array(squares), count, max(total, 1e-300)),
    )


def _classes(
    lengths: Array, steps: NDArray[np.int64], squares: Array, count: int, total: float
) -> tuple[DurationClass, ...]:
    """Classes of outages with durations (R,) s, numbers of steps (R,) and sums of squared distances (R,)."""
    # Sums of durations of 0.1 s may exceed a limit by rounding.
    index = np.searchsorted(DURATIONS, lengths * (1.0 - 1e-9))
    bounds = (0.0, *DURATIONS, math.inf)
    result = []
    for number in np.unique(index[steps > 0]):
        at = index == number
        square, n = float(squares[at].sum()), int(steps[at].sum())
        low, high = bounds[number : number + 2]
        result.append(DurationClass(low, high, int(at.sum()), n / count, square / n, square / total))
    return tuple(result)


def root_mean_square(values: Sequence[float] | Array) -> float:
    """Root of the mean square of the known values; NaN without any."""
    return math.sqrt(measures.known_mean(np.square(np.asarray(values, dtype=np.float64))))

"""Innovations in the spaces of the measurements, and the gates that reject them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import display_name
from beliefscope.datasets.text import percent, plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry, drawn_steps
from beliefscope.inspect.diagnostics.views import Array, Curve, Table
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.innovations import (
    TAIL,
    are_extreme,
    nis_of,
    squared_innovations,
    virtual_innovations,
)
from beliefscope.inspect.statistics.intervals import mean_interval, too_few
from beliefscope.inspect.trace import Trace

EXCESS = 10.0
"""Smallest ratio of the number of accepted extreme innovations to its expectation at which a gate should have acted."""

ALWAYS = 0.95
"""Share of rejected measurements from which a gate always rejects."""

LOCKED = 20
"""Number of rejections in succession from which the filter has lost the measurement."""


@dataclass(frozen=True)
class ModalityInnovations:
    """Innovations of one measurement.

    Attributes:
        measurements: number of counted steps with a measurement. channels: largest number of channels.
        nis: mean of NIS / m, of the accepted measurements if there are any.
        low, high: its 95 % interval over episodes; NaN for too few.
        extreme: number of innovations beyond the ``TAIL`` quantile of a consistent filter.
        accepted: share of accepted measurements; NaN without a gate. missed: number of accepted extreme innovations.
        longest: largest number of rejections in succession.
    """

    modality: str
    measurements: int
    channels: int
    nis: float
    low: float
    high: float
    extreme: int
    accepted: float
    missed: int
    longest: int

    @property
    def gate(self) -> str:
        """Status of the gate; empty without one."""
        if math.isnan(self.accepted):
            return ""
        if self.accepted <= 1.0 - ALWAYS:
            return "always rejects"
        if self.longest >= LOCKED:
            return f"rejects {plural(self.longest, 'measurement')} in succession"
        if self.accepted == 1.0:
            return "never acts" if self.missed > EXCESS * TAIL * self.measurements else "never needed"
        return "acts"

    @property
    def consistent(self) -> bool:
        """Whether the interval of NIS / m contains one, or is unknown."""
        return not (self.low > 1.0 or self.high < 1.0)


@dataclass(frozen=True)
class Innovations(Diagnostic):
    """Result of ``innovations_of``.

    Attributes:
        filter, trajectories: filter name and number of traces.
        modalities: innovations of each measurement.
        nis: (T, K) NIS / m by step of a single trace; (0, K) for several.
        rejected: (T,) whether any gate rejected a measurement, of a single trace.
    """

    filter: str
    trajectories: int
    modalities: tuple[ModalityInnovations, ...]
    nis: Array
    rejected: NDArray[np.bool_]

    @property
    def verdict(self) -> str:
        sentences = []
        for entry in self.modalities:
            if not entry.measurements:
                sentences.append(f"{display_name(entry.modality)}: no measurement.")
                continue
            size = f"{display_name(entry.modality)}: NIS/m {entry.nis:.3g}"
            if not math.isnan(entry.low):
                size += f" [{entry.low:.3g}, {entry.high:.3g}], "
                size += "consistent" if entry.consistent else "inconsistent"
            gate = f"the gate {entry.gate}" if entry.gate and not entry.gate.startswith("never n") else ""
            if entry.gate == "never acts":
                gate += f", although {entry.missed} of {entry.measurements} innovations exceed the 99.9 % quantile"
            elif not entry.gate and entry.extreme > EXCESS * TAIL * entry.measurements:
                gate = f"{entry.extreme} of {entry.measurements} exceed the 99.9 % quantile, and there is no gate"
            elif entry.gate:
                rejected = percent(1.0 - entry.accepted, ".1f")
                share = f"{rejected} of {plural(entry.measurements, 'measurement')} rejected"
                gate = f"{gate}, {share}" if gate else "no measurement had to be rejected"
            sentences.append("; ".join(filter(None, [size, gate])) + ".")
        return " ".join(sentences)

    @property
    def alarms(self) -> tuple[str, ...]:
        wrong = [e for e in self.modalities if e.gate not in ("", "acts", "never needed")]
        inconsistent = [display_name(e.modality) for e in self.modalities if not e.consistent]
        return (
            *(f"the gate of {display_name(e.modality)} {e.gate}" for e in wrong),
            *(f"innovations of {name} are inconsistent" for name in inconsistent),
        )

    def tables(self) -> list[Table]:
        rows = [
            {
                "measurement": display_name(e.modality),
                "steps": e.measurements,
                "channels": e.channels,
                "NIS/m": e.nis,
                "95 % from": e.low,
                "to": e.high,
                "beyond 99.9 %": e.extreme,
                "accepted (%)": 100.0 * e.accepted,
                "longest rejection (steps)": None if math.isnan(e.accepted) else e.longest,
                "gate": e.gate or "none",
            }
            for e in self.modalities
        ]
        return [Table.from_rows("Innovations of the measurements", rows)]

    def curves(self) -> list[Curve]:
        title = "Innovation in predicted standard deviations (root of NIS/m)"
        return [
            Curve(display_name(e.modality), measures.root(self.nis[:, k]), title, "standard deviations", e.modality)
            for k, e in enumerate(self.modalities)
            if len(self.nis)
        ]

    def bands(self) -> dict[str, NDArray[np.bool_]]:
        return {"rejected": self.rejected} if len(self.nis) else {}


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if trace.innovation is not None:
        return None
    if virtual_innovations(trace) is not None:
        return (
            f"the virtual sensors of filter {trace.filter} measure the state; their innovations, NIS/n, are in the "
            "diagnostic Consistency"
        )
    return f"filter {trace.filter} reports no innovations of its measurements"


def innovations_of(traces: Sequence[Trace]) -> Innovations:
    """Evaluate the innovations and gates of one filter over one or more episodes."""
    first, keep = traces[0], drawn_steps(traces)
    rejected = np.zeros(len(first), dtype=bool) if first.accepted is None else (first.accepted == 0.0).any(1)
    return Innovations(
        filter=first.filter,
        trajectories=len(traces),
        modalities=tuple(_modality(traces, k, name) for k, name in enumerate(first.modalities)),
        nis=np.asarray(nis_of(first))[:keep],
        rejected=rejected[:keep],
    )


def _modality(traces: Sequence[Trace], k: int, name: str) -> ModalityInnovations:
    squared, channels, accepted, sums, counts, longest = [], [], [], [], [], 0
    for trace in traces:
        pair = squared_innovations(trace)
        assert pair is not None
        keep = measures.counted(trace) & np.isfinite(pair[0][:, k])
        used = np.full(len(trace), np.nan) if trace.accepted is None else trace.accepted[:, k]
        squared.append(pair[0][keep, k])
        channels.append(pair[1][keep, k])
        accepted.append(used[keep])
        usable = accepted[-1] != 0.0
        sums.append((squared[-1] / channels[-1])[usable].sum())
        counts.append(usable.sum())
        runs = measures.intervals(used[np.isfinite(pair[0][:, k])] == 0.0)
        longest = max([longest, *(int(stop - start) for start, stop in runs)])
    value, m, used = (np.concatenate(parts) for parts in (squared, channels, accepted))
    total = len(value)
    usable = used != 0.0 if (used != 0.0).any() else np.ones(total, dtype=bool)
    low = high = math.nan
    if too_few(len(traces)) is None and min(counts) > 0:
        _, low, high = (float(x) for x in mean_interval(np.array(sums), np.array(counts, np.float64)))
    extreme = are_extreme(value, m)
    gated = total > 0 and np.isfinite(used).all()
    return ModalityInnovations(
        modality=name,
        measurements=total,
        channels=int(m.max(initial=0)),
        nis=float(np.mean((value / m)[usable])) if total else math.nan,
        low=low,
        high=high,
        extreme=int(extreme.sum()),
        accepted=float(np.mean(used)) if gated else math.nan,
        missed=int((extreme & (used == 1.0)).sum()) if gated else 0,
        longest=longest,
    )


ENTRY = Entry(
    name="innovations",
    title="Innovations and gates",
    question="Do measurements deviate from their predictions as predicted, and does the gate reject the right ones?",
    run=innovations_of,
    why_not=why_not,
)

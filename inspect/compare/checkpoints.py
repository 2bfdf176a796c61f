"""What a change of a filter mended and what it broke: two checkpoints over the same held-out episodes, by slice."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import Foreign
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.slices import Slice, slices_of
from beliefscope.inspect.compare.effects import LEVEL, Difference, Worsening, differences, worsenings
from beliefscope.inspect.compare.modules import ModuleChange, module_changes
from beliefscope.inspect.diagnostics.base import Array, Diagnostic, Line, Plot, Table, Value
from beliefscope.inspect.statistics.bootstrap import FEWEST
from beliefscope.inspect.statistics.calibration import LEVELS
from beliefscope.inspect.statistics.episode_sums import curve, measures_of, spread, tally

SHOWN = 20
"""Rows of what was mended and what damaged."""

PROBED = 128
"""Steps at which the modules' outputs are compared."""

DEPTH = 3
"""Names of so many parts are in the table of modules, of frozen ones only the outermost; all are in the result."""


@dataclass(frozen=True)
class Part:
    """A slice, and how much of the data it has: episodes with a step in it that counts, and such steps."""

    slice: Slice
    episodes: int
    steps: int


@dataclass(frozen=True)
class Change(Diagnostic):
    """Result of ``change_of``; pairs are before and after.

    Attributes:
        task: its name. filters, hashes: names and hashes of the checkpoints. child: whether the second says that it was
            made from the first.
        episodes: indices in the data set that both ran over. seed, particles: of both.
        parts: the slices. left_out: those that the filters do not fit, and why.
        differences: every measure in every slice, in their order.
        calibration: (S, 2, P) share of steps whose truth lies in the region of each of ``levels`` (P,).
        moments: those that got worse, the greatest rise first.
        modules: what became of each that both have.
    """

    task: str
    filters: tuple[str, str]
    hashes: tuple[str, str]
    child: bool
    episodes: tuple[int, ...]
    seed: int
    particles: int | None
    parts: tuple[Part, ...]
    left_out: tuple[str, ...]
    differences: tuple[Difference, ...]
    levels: Array
    calibration: Array
    moments: tuple[Worsening, ...]
    modules: tuple[ModuleChange, ...]

    def mended(self) -> list[Difference]:
        """The most first: errors, then beliefs."""
        return sorted((d for d in self.differences if d.mended), key=lambda d: (not d.is_error, d.effect))

    def damaged(self) -> list[Difference]:
        """The worst first: errors, then beliefs."""
        return sorted((d for d in self.differences if d.damaged), key=lambda d: (not d.is_error, -d.effect))

    @property
    def frozen(self) -> tuple[str, ...]:
        """The outermost modules whose parameters and buffers have the hashes that they had."""
        same = [m.name for m in self.modules if m.same]
        return tuple(n for n in same if not any(n.startswith(f"{other}.") for other in same))

    @property
    def verdict(self) -> str:
        if self.hashes[0] == self.hashes[1] or not any(d.effect for d in self.differences):
            return f"{self.filters[1]} does exactly what {self.filters[0]} does: nothing is mended and nothing damaged."
        if len(self.episodes) < FEWEST:
            return f"{len(self.episodes)} episodes are too few to tell what changed: intervals need {FEWEST}."
        errors = [d for d in self.differences if d.is_error]
        mended, damaged = self.mended(), self.damaged()
        return f"{_sentence('Mends', mended, errors, -1.0)}; {_sentence('damages', damaged, errors, 1.0)}."

    def tables(self) -> list[Table]:
        errors, beliefs = ([d for d in self.differences if d.is_error is kind] for kind in (True, False))
        by_slice = ("slice", "measure", "unit", "before", "after")
        parts = Table(
            "Slices",
            ("slice", "sensors", "steps in", "only", "episodes", "steps"),
            tuple(map(_part_row, self.parts)),
        )
        return [
            *(
                Table(title, ("slice", "measure", "before -> after", "change", "95 % interval"), tuple(rows[:SHOWN]))
                for title, found in (("Mended", self.mended()), ("Damaged, the worst first", self.damaged()))
                if (rows := [(d.slice, _title(d), *_told(d)) for d in found])
            ),
            Table(
                "Errors by slice (RMSE)",
                (*by_slice, "change %", "low %", "high %", "judgement"),
                tuple((*_numbers(d), *(_percent(x) for x in (d.effect, d.low, d.high)), _judged(d)) for d in errors),
            ),
            Table(
                "Beliefs by slice",
                (*by_slice, "effect", "low", "high", "judgement"),
                tuple((*_numbers(d), *(_known(x) for x in (d.effect, d.low, d.high)), _judged(d)) for d in beliefs),
            ),
            self.table_of(self.moments),
            Table(
                "Modules",
                (
                    "module",
                    "class",
                    "parameters",
                    "gradient",
                    "weights changed %",
                    "output drift %",
                    "frozen",
                    "SHA-256",
                ),
                tuple(
                    _module_row(m)
                    for m in self.modules
                    if m.name in self.frozen or (not m.same and m.name.count(".") < DEPTH)
                ),
            ),
            parts,
        ]

    def table_of(self, moments: Sequence[Worsening]) -> Table:
        """A line a moment."""
        columns = ("slice", "episode", "step", "from", "to", "contact", "before cm", "after cm", "rise cm")
        rows = tuple(
            (
                m.slice,
                m.episode,
                m.step,
                m.first,
                m.last,
                "yes" if m.contact else "no",
                100 * m.before,
                100 * m.after,
                100 * (m.after - m.before),
            )
            for m in moments
        )
        return Table("Moments that got worse", columns, rows)

    def plots(self) -> list[Plot]:
        """Position error by slice with its change; calibration of the first slice and of the one that changed most."""
        position = [d for d in self.differences if d.measure == "position"]
        names = tuple(d.slice for d in position)
        x = np.arange(len(position), dtype=np.float64)
        before, after = (np.array(values) for values in zip(*(d.shown[:2] for d in position), strict=True))
        bars = (Line("before", x, before), Line("after", x, after, "fused"))
        plots = [Plot("Position by slice", "", "RMSE (cm)", bars, "bars", names=names)]
        if np.isnan(self.calibration).all():
            return plots
        far = np.nan_to_num(np.abs(self.calibration[:, 1] - self.calibration[:, 0]).mean(-1))
        for s in dict.fromkeys((0, int(far.argmax()))):
            lines = tuple(
                Line(name, self.levels, self.calibration[s, i], layer)
                for i, (name, layer) in enumerate((("before", ""), ("after", "fused")))
            )
            title = f"Calibration: {self.parts[s].slice.name}"
            plots.append(Plot(title, "level of the region", "share of truths in it", lines, diagonal=True))
        return plots


def change_of(
    before: Checkpoint,
    after: Checkpoint,
    data: Dataset | Mapping[int, Episode] | Sequence[Episode],
    episodes: Iterable[int] | None = None,
    *,
    slices: Sequence[Slice] = (),
    particles: int = 300,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Change:
    """Holds two checkpoints of one task and modalities against each other.

    Both run with the same broken sensors and the same random numbers; intervals draw whole episodes, the same for both.

    Args:
        episodes: indices in ``data``; without them those that a ``Dataset`` holds out, or all.
        slices: looked at beside the standard ones (``slices_of``). progress: called with the share done, 0..1.

    Raises BadInput for checkpoints that cannot be compared, slices that do not fit them, and as ``evaluate`` does.
    """
    filters = _comparable(before, after)
    task = before.task
    for one in slices:
        for filter_ in filters:
            one.check(task, filter_.names)
    chosen, left_out = _standard(filters, {one.name for one in slices})
    chosen += slices
    if episodes is None and isinstance(data, Dataset):
        episodes = data.held_out()
    elif episodes is None:
        episodes = data if isinstance(data, Mapping) else range(len(data))
    indices = tuple(episodes)
    members = [data[index] for index in indices]
    found = tally(filters, chosen, members, particles=particles, seed=seed, progress=progress)
    counts = found.sums[:, 0, :, 0]
    child = (after.record.get("parent") or {}).get("hash") == before.hash
    return Change(
        task=task.name,
        filters=(before.name, after.name),
        hashes=(before.hash, after.hash),
        child=child,
        episodes=indices,
        seed=seed,
        particles=particles if "pf" in (before.kind, after.kind) else None,
        parts=tuple(Part(one, int((counts[:, s] > 0).sum()), int(counts[:, s].sum())) for s, one in enumerate(chosen)),
        left_out=left_out,
        differences=differences(found.sums, [one.name for one in chosen], measures_of(task)),
        levels=LEVELS,
        calibration=curve(found.sums.sum(0)).swapaxes(0, 1),
        moments=worsenings(found, chosen, indices, members, task.dt),
        modules=module_changes(*filters, spread(members, task, PROBED), after.record.get("parts") if child else None),
    )


def _comparable(before: Checkpoint, after: Checkpoint) -> tuple[Filter, Filter]:
    for one in (before, after):
        if isinstance(one, Foreign):
            raise BadInput(
                f"{one.source} is from outside: what a change did is told of two checkpoints of this project"
            )
    if before.task.name != after.task.name:
        raise BadInput(f"checkpoints are of tasks {before.task.name!r} and {after.task.name!r}; give two of one task")
    if set(before.filter.names) != set(after.filter.names):
        a, b = (", ".join(one.filter.names) for one in (before, after))
        raise BadInput(f"checkpoints have modalities {a} and {b}; give two of the same modalities")
    return before.filter, after.filter


def _standard(filters: Sequence[Filter], without: set[str]) -> tuple[list[Slice], tuple[str, ...]]:
    """The standard slices that the filters fit, but for some names; and of the others why they do not."""
    chosen, left_out = list[Slice](), list[str]()
    for one in slices_of(filters[0].task):
        try:
            for filter_ in filters:
                one.check(filter_.task, filter_.names)
        except BadInput as error:
            left_out.append(f"{one.name}: {error}")
            continue
        # One modality alone is all that there is, where there is only one.
        if one.name not in without and not (one.only and len(filters[0].names) == 1):
            chosen.append(one)
    return chosen, tuple(left_out)


MEASURES = {"nll": "NLL", "nees": "NEES", "coverage95": "coverage of 95 %"}
"""Measures whose names are not words."""


def _sentence(verb: str, found: Sequence[Difference], errors: Sequence[Difference], sign: float) -> str:
    """What the first of them is, with its numbers, and how many more there are.

    Where there is none: whether the intervals exclude any, or else the error that changed most in this direction.

    Args:
        errors: all of them. sign: of the effect, 1 where worse.
    """
    if found:
        return f"{verb} {_numbered(found[0])}{f' and {len(found) - 1} more' if len(found) > 1 else ''}"
    possible = [d for d in errors if max(sign * d.low, sign * d.high) >= math.log1p(LEVEL)]
    if not possible:
        return f"{verb} nothing beyond {100 * LEVEL:.0f} %"
    most = max(possible, key=lambda d: sign * d.effect)
    return f"{verb} nothing for certain" + (f", most likely {_numbered(most)}" if sign * most.effect > 0.0 else "")


def _numbered(d: Difference) -> str:
    values, change, interval = _told(d)
    return f"{d.slice}: {_title(d)} {values} ({change}, 95 % interval {interval})"


def _title(d: Difference) -> str:
    return MEASURES.get(d.measure, d.measure.replace("_", " "))


def _told(d: Difference) -> tuple[str, str, str]:
    """Before and after, the change, and its interval, as text."""
    before, after, unit = d.shown
    shares = d.measure not in ("coverage95", "miscalibration")
    one, low, high = (_factor(x) if shares else f"{100 * x:+.1f}" for x in (d.effect, d.low, d.high))
    unit_of_change = " %" if shares else " points off"
    return f"{before:.3g} -> {after:.3g} {unit}".rstrip(), f"{one}{unit_of_change}", f"{low} to {high}"


def _factor(effect: float) -> str:
    """A factor's logarithm as per cent more or less."""
    return f"{100 * math.expm1(min(effect, 30.0)):+.3g}"


def _numbers(d: Difference) -> tuple[Value, ...]:
    before, after, unit = d.shown
    return d.slice, _title(d), unit, before, after


def _percent(effect: float) -> float | None:
    return round(100.0 * math.expm1(min(effect, 30.0)), 2) if math.isfinite(effect) else None


def _known(effect: float) -> float | None:
    return round(effect, 4) if math.isfinite(effect) else None


def _judged(d: Difference) -> str:
    return "mended" if d.mended else "damaged" if d.damaged else ""


def _part_row(part: Part) -> tuple[Value, ...]:
    one = part.slice
    contact = "all" if one.contact is None else "contact" if one.contact else "no contact"
    return one.name, str(one.faults), contact, " + ".join(one.only), part.episodes, part.steps


def _module_row(m: ModuleChange) -> tuple[Value, ...]:
    changed, drift = (None if math.isnan(x) else 100.0 * x for x in (m.weights, m.drift))
    gradient = None if math.isnan(m.gradient) else m.gradient
    hashes = m.hashes[0][:12] if m.same else " -> ".join(digest[:12] for digest in m.hashes)
    return m.name, m.kind, m.parameters, gradient, changed, drift, "same" if m.same else "", hashes

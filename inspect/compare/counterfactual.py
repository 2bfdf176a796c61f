"""Counterfactuals in time: what the filter would have believed, had a sensor or a weight been another for a while."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Array, Curve, Diagnostic, Table, Value
from beliefscope.inspect.statistics.measures import (
    covariances,
    errors,
    means,
    position_error,
    shown_units,
    task_of,
    wrapped,
)
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.replay import Edit, Replay

RECOVERED = 1.0
"""The edited estimate is back where it is within so many of the original's own standard deviations, and stays there."""

RISE = 0.05
"""A smaller change of a share in the fused result is not worth a name."""


@dataclass(frozen=True)
class Counterfactual(Diagnostic):
    """An original run and an edited one, which draw the same random numbers at every step.

    T steps, n components, K modalities; m and rad.

    Attributes:
        task, filter, modalities: of the traces. what: the edit in words. first, to: its steps, ``to`` not included.
        truth, original, edited: (T, n): the true state and the fused estimates of both runs.
        distance: (T,) m on the map, between the fused estimates. modality_distance: (T, K) m, between what each
            modality believes by itself.
        sigmas: (T,) ``sqrt(d^T S^-1 d / n)``, d the difference of the estimates and S the original's covariance; where
            it has none, the mean square of its own errors by component.
        divergence: (T,) nats, Kullback-Leibler of the original posterior from the edited one, as Gaussians; NaN where
            there is no covariance.
        error, edited_error: (T,) m on the map, from the truth.
        share, edited_share: (T, K) share of each modality in the fused result as it acted, its mean over components;
            None where nothing is fused.
        contact: (T,) bool.
        back: first step after the edit from which ``sigmas`` stays at most ``RECOVERED``; None where there is none.
    """

    task: str
    filter: str
    modalities: tuple[str, ...]
    what: str
    first: int
    to: int
    truth: Array
    original: Array
    edited: Array
    distance: Array
    modality_distance: Array
    sigmas: Array
    divergence: Array
    error: Array
    edited_error: Array
    share: Array | None
    edited_share: Array | None
    contact: NDArray[np.bool_]
    back: int | None

    @property
    def during(self) -> slice:
        """The edited steps."""
        return slice(self.first, self.to)

    @property
    def carrier(self) -> str | None:
        """The modality whose share rose most over the edited steps; None where none rose by more than ``RISE``."""
        if self.share is None or self.edited_share is None:
            return None
        rise = (self.edited_share - self.share)[self.during].mean(0)
        return self.modalities[int(rise.argmax())] if rise.max() > RISE else None

    @property
    def verdict(self) -> str:
        if not self.distance.any() and not self.sigmas.any():
            return f"{_sentence(self.what)} changed nothing."
        peak = int(self.distance.argmax())
        text = f"{self.what} moved the estimate by at most {100 * self.distance[peak]:.2f} cm (step {peak})"
        for name, (largest, step, unit) in self._peaks().items():
            if name not in self._mapped():
                text += f" and the {name} by {largest:.1f} {unit} (step {step})"
        text = f"{_sentence(text)}: {self._recovery()}. "
        before, after = (float(100 * error[self.during].mean()) for error in (self.error, self.edited_error))
        text += f"Over these steps the error went from {before:.2f} to {after:.2f} cm"
        return f"{text}{self._carried()}."

    def _recovery(self) -> str:
        """How far in the original's sigmas, and when it was back."""
        far = float(self.sigmas[self.first :].max())
        if far <= RECOVERED:
            return f"never more than {far:.1f} of the original's own sigma"
        text = f"up to {far:.1f} of the original's own sigma"
        if self.to >= len(self.sigmas):
            return text
        if self.back is None:
            return f"{text}, and not back within one by the last step"
        late = self.back - self.to
        return f"{text}, back within one " + (f"{late} steps after it" if late else "as soon as it was over")

    def _carried(self) -> str:
        """Which modality decided meanwhile."""
        if self.share is None or self.edited_share is None:
            return ""
        before, after = self.share[self.during].mean(0), self.edited_share[self.during].mean(0)
        name = self.carrier or self.modalities[int(after.argmax())]
        k = self.modalities.index(name)
        shares = f"its share in the result {before[k]:.2f} -> {after[k]:.2f}"
        if not self.carrier:
            return f"; shares hardly changed, {name} decided as before ({shares})"
        return f"; {name} {'carried it' if before[k] < 0.5 <= after[k] else 'gained'} ({shares})"

    def _mapped(self) -> tuple[str, ...]:
        task = find_task(self.task)
        return tuple(task.components[i].name for i in task.map_indices)

    def _peaks(self) -> dict[str, tuple[float, int, str]]:
        """Component -> its largest difference as shown, the step, the unit."""
        task = find_task(self.task)
        units, factors = shown_units(task)
        apart = np.abs(wrapped(task, self.edited - self.original)) * factors
        steps = apart.argmax(0)
        return {
            component.name: (float(apart[steps[i], i]), int(steps[i]), units[i])
            for i, component in enumerate(task.components)
        }

    def tables(self) -> list[Table]:
        spans = {"edited steps": self.during, "after": slice(self.to, None), "all": slice(None)}
        rows: list[tuple[Value, ...]] = []
        for name, span in spans.items():
            if not len(self.error[span]):
                continue
            of = (100 * self.error[span].mean(), 100 * self.edited_error[span].mean(), 100 * self.distance[span].mean())
            rows.append((name, *map(float, of), _number(self.divergence[span].mean())))
        columns = ("steps", "error, cm", "error edited, cm", "distance of the two, cm", "divergence, nats")
        tables = [Table("Mean over steps", columns, tuple(rows))]
        peaks = tuple((name, largest, unit, step) for name, (largest, step, unit) in self._peaks().items())
        tables.append(Table("Largest difference of the estimates", ("component", "by", "unit", "step"), peaks))
        if self.modalities:
            tables.append(self._modality_table())
        return tables

    def _modality_table(self) -> Table:
        columns: tuple[str, ...] = ("modality", "own estimate moved, cm")
        moved = 100 * self.modality_distance[self.during].mean(0)
        rows: list[tuple[Value, ...]] = [(m, float(moved[k])) for k, m in enumerate(self.modalities)]
        if self.share is not None and self.edited_share is not None:
            columns = (*columns, "share", "share edited")
            both = (self.share[self.during].mean(0), self.edited_share[self.during].mean(0))
            rows = [(*row, float(both[0][k]), float(both[1][k])) for k, row in enumerate(rows)]
        return Table("Over the edited steps, mean", columns, tuple(rows))

    def curves(self) -> list[Curve]:
        chart = "How far the edit moves the estimates"
        curves = [Curve("fused", 100 * self.distance, chart, "cm", "fused")]
        for k, m in enumerate(self.modalities if len(self.modalities) > 1 else ()):
            curves.append(Curve(f"{m} by itself", 100 * self.modality_distance[:, k], chart, "cm", m))
        curves.append(Curve("fused", self.sigmas, "The same in the original's sigma", "", "fused", (0.0, RECOVERED)))
        for layer_error, name in ((self.error, "original"), (self.edited_error, "edited")):
            curves.append(Curve(name, 100 * layer_error, "Error", "cm", "fused"))
        if self.share is not None and self.edited_share is not None:
            for k, m in enumerate(self.modalities):
                for share, name in ((self.share, m), (self.edited_share, f"{m} edited")):
                    curves.append(Curve(name, share[:, k], "Share in the result", "", m))
        task = find_task(self.task)
        units, factors = shown_units(task)
        for i, component in enumerate(task.components):
            for values, name, layer in (
                (self.truth, "truth", "truth"),
                (self.original, "original", "fused"),
                (self.edited, "edited", "fused"),
            ):
                curves.append(Curve(name, factors[i] * values[:, i], component.name, units[i], layer))
        return curves

    def bands(self) -> dict[str, NDArray[np.bool_]]:
        steps = np.arange(len(self.distance))
        return {"contact": self.contact, "edit": (steps >= self.first) & (steps < self.to)}


def counterfactual(checkpoint: Checkpoint, trace: Trace, edit: Edit) -> Counterfactual:
    """The trace's run again with the edit, beside the run without it. Raises BadInput as ``Replay.edited`` does."""
    replay = Replay(checkpoint, trace)
    return compare(replay.original, replay.edited(edit), edit)


def compare(original: Trace, edited: Trace, edit: Edit) -> Counterfactual:
    """What the edit changed. Raises BadInput for traces of different length."""
    if len(original) != len(edited):
        raise BadInput(f"traces of {len(original)} and {len(edited)} steps are not of one run")
    task = task_of(original)
    apart = wrapped(task, means(edited) - means(original))
    on_map = np.linalg.norm(apart[..., list(task.map_indices)], axis=-1)
    fused = apart[:, -1]
    shares = [None if one.acting is None else one.acting.mean(-1, dtype=np.float64) for one in (original, edited)]
    sigmas = _in_sigmas(original, fused)
    return Counterfactual(
        task=task.name,
        filter=original.filter,
        modalities=original.modalities,
        what=str(edit),
        first=edit.first,
        to=edit.to,
        truth=original.episode.states.astype(np.float64),
        original=original.estimate_mean.astype(np.float64),
        edited=edited.estimate_mean.astype(np.float64),
        distance=on_map[:, -1],
        modality_distance=on_map[:, :-1],
        sigmas=sigmas,
        divergence=_divergence(original, edited, fused),
        error=position_error(original)[:, -1],
        edited_error=position_error(edited)[:, -1],
        share=shares[0],
        edited_share=shares[1],
        contact=original.episode.contact.astype(bool),
        back=_back(sigmas, edit.to),
    )


def _in_sigmas(original: Trace, difference: Array) -> Array:
    """(T,): differences (T, n) of the fused estimate in the original's standard deviations."""
    if original.has_covariance:
        covariance = covariances(original)[:, -1]
    else:
        covariance = np.diag(np.square(errors(original)[:, -1]).mean(0))[None]
    white = np.linalg.solve(covariance, difference[..., None])[..., 0]
    return np.sqrt(np.maximum(np.einsum("tn,tn->t", difference, white) / difference.shape[-1], 0.0))


def _divergence(original: Trace, edited: Trace, difference: Array) -> Array:
    """(T,) nats: ``KL(N(m, S) || N(m', S')) = (tr S'^-1 S + d^T S'^-1 d - n + ln det S' - ln det S) / 2``."""
    if not original.has_covariance:
        return np.full(len(original), np.nan)
    s, s_edited = covariances(original)[:, -1], covariances(edited)[:, -1]
    both = np.concatenate([s, difference[..., None]], axis=-1)
    solved = np.linalg.solve(s_edited, both)
    n = s.shape[-1]
    trace_term = np.einsum("tii->t", solved[..., :n])
    quadratic = np.einsum("tn,tn->t", difference, solved[..., n])
    volume = np.linalg.slogdet(s_edited).logabsdet - np.linalg.slogdet(s).logabsdet
    return 0.5 * (trace_term + quadratic - n + volume)


def _back(sigmas: Array, to: int) -> int | None:
    """First step from ``to`` on from which all are at most ``RECOVERED``."""
    beyond = np.flatnonzero(sigmas[to:] > RECOVERED)
    back = to + (int(beyond[-1]) + 1 if len(beyond) else 0)
    return back if back < len(sigmas) else None


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None

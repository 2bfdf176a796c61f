"""Counterfactuals: the effect of sensor faults or manual fusion weights over a range of steps on the estimates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task, display_name
from beliefscope.datasets.text import plural
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.diagnostics.views import Curve, Table, Value, known_number
from beliefscope.inspect.statistics.measures import (
    Array,
    covariances,
    display_units,
    errors,
    layer_label,
    main_error,
    means,
)
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.replay import Intervention

RECOVERED = 1.0
"""The run has recovered once its estimate stays within this many standard deviations of the original."""

MIN_INCREASE = 0.05
"""Minimum reported increase of an effective weight."""

MAX_OTHERS = 2
"""Maximum number of components beside those of the main error in the verdict; all are in the tables."""


@dataclass(frozen=True)
class Counterfactual(Diagnostic):
    """Comparison of a run and the same run with an intervention, with equal random numbers.

    T steps, n components, K modalities; m and rad.

    Attributes:
        task, filter, modalities: of the traces.
        intervention: in words.
        first, to: first step of the intervention, and first step after it.
        truth, original, counterfactual: (T, n) true states, and fused estimates without and with the intervention.
        distance: (T,) m, distance between the fused position estimates.
        modality_distance: (T, K) m, distance between the positions of the single-modality updates.
        sigmas: (T,) ``sqrt(d^T S^-1 d / n)`` for the difference d of the estimates and the covariance S of the original
            run; without a covariance, S is the mean squared error by component.
        divergence: (T,) nats, Kullback-Leibler divergence of the original posterior from the counterfactual one, as
            Gaussians; NaN without a covariance.
        error, counterfactual_error: (T,) m, position errors.
        effective_weights, counterfactual_weights: (T, K) effective weights, averaged over components; None without
            fusion.
        contact: (T,) bool.
        time: (T,) s, times of the steps; None without timestamps.
        recovery: first step after the intervention from which ``sigmas`` stays at most ``RECOVERED``; None without
            one.
    """

    task: Task
    filter: str
    modalities: tuple[str, ...]
    intervention: str
    first: int
    to: int
    truth: Array
    original: Array
    counterfactual: Array
    distance: Array
    modality_distance: Array
    sigmas: Array
    divergence: Array
    error: Array
    counterfactual_error: Array
    effective_weights: Array | None
    counterfactual_weights: Array | None
    contact: NDArray[np.bool_]
    time: Array | None
    recovery: int | None

    @property
    def during(self) -> slice:
        """The steps of the intervention."""
        return slice(self.first, self.to)

    @property
    def carrier(self) -> str | None:
        """The modality whose effective weight increased most during the intervention, by at least ``MIN_INCREASE``."""
        if self.effective_weights is None or self.counterfactual_weights is None:
            return None
        increase = (self.counterfactual_weights - self.effective_weights)[self.during].mean(0)
        return self.modalities[int(increase.argmax())] if increase.max() > MIN_INCREASE else None

    @property
    def verdict(self) -> str:
        if not self.distance.any() and not np.nan_to_num(self.sigmas).any():
            return f"With {self.intervention}, nothing changed."
        peak = int(self.distance.argmax())
        largest = self.task.main_error.text(self.distance[peak])
        text = f"With {self.intervention}, the estimate moved by up to {largest} ({self._at(peak)})"
        others = {name: peak for name, peak in self._peaks().items() if name not in self._main()}
        for name, (change, step, unit) in others.items() if len(others) <= MAX_OTHERS else ():
            text += f" and the {name} by up to {change:.3g} {unit} ({self._at(step)})"
        text = f"{text}, {self._recovery()}. "
        main = self.task.main_error
        errors = (self.error, self.counterfactual_error)
        before, after = (main.factor * float(error[self.during].mean()) for error in errors)
        text += f"Mean {main.name} error during the intervention: {before:.2f} -> {after:.2f} {main.unit}".rstrip()
        return f"{text}{self._weight_text()}."

    def _recovery(self) -> str:
        """Largest difference in standard deviations, and when the run with the intervention recovered."""
        largest = float(np.nanmax(self.sigmas[self.first :]))  # NaN where the covariance is unknown
        text = f"at most {largest:.1f} standard deviations of the original run"
        if largest <= RECOVERED or self.to >= len(self.sigmas):
            return text
        if self.recovery is None:
            return f"{text}, and did not recover by the last step"
        delay = self.recovery - self.to
        if not delay:
            return f"{text}, and recovered immediately after the intervention"
        seconds = "" if self.time is None else f" ({self.time[self.recovery] - self.time[self.to]:.2f} s)"
        return f"{text}, and recovered {plural(delay, 'step')}{seconds} after the intervention"

    def _at(self, step: int) -> str:
        """A step, and its time where the data have timestamps."""
        return f"step {step}" if self.time is None else f"step {step}, {self.time[step]:.2f} s"

    def _weight_text(self) -> str:
        """Effective weight of the dominant modality during the intervention."""
        if self.effective_weights is None or self.counterfactual_weights is None:
            return ""
        before, after = self.effective_weights[self.during].mean(0), self.counterfactual_weights[self.during].mean(0)
        name = self.carrier or self.modalities[int(after.argmax())]
        k = self.modalities.index(name)
        change = f"effective weight of {display_name(name)} {before[k]:.2f} -> {after[k]:.2f}"
        if not self.carrier:
            return f"; {display_name(name)} remained dominant ({change})"
        return (
            f"; {display_name(name)} {'became dominant' if before[k] < 0.5 <= after[k] else 'gained weight'} ({change})"
        )

    def _main(self) -> tuple[str, ...]:
        task = self.task
        return tuple(task.components[i].label for i in task.main_error.indices)

    def _peaks(self) -> dict[str, tuple[float, int, str]]:
        """Component -> largest difference in display units, step, unit."""
        task = self.task
        units, factors = display_units(task)
        difference = np.abs(task.difference(self.counterfactual, self.original)) * factors
        steps = difference.argmax(0)
        return {
            component.label: (float(difference[steps[i], i]), int(steps[i]), units[i])
            for i, component in enumerate(task.components)
        }

    def tables(self) -> list[Table]:
        main = self.task.main_error
        spans = {"intervention": self.during, "after": slice(self.to, None), "all": slice(None)}
        names = (f"{name}, {main.unit}".rstrip(", ") for name in ("error", "error with intervention", "distance"))
        means = [
            (
                name,
                *(main.factor * e[span].mean() for e in (self.error, self.counterfactual_error, self.distance)),
                known_number(self.divergence[span].mean()),
            )
            for name, span in spans.items()
            if len(self.error[span])
        ]
        peaks = [
            {"component": name, "difference": largest, "unit": unit, "step": step}
            | ({} if self.time is None else {"time (s)": self.time[step]})
            for name, (largest, step, unit) in self._peaks().items()
        ]
        return [
            Table("Mean over steps", ("steps", *names, "divergence, nats"), means),
            Table.from_rows("Largest difference of the estimates", peaks),
            *([Table.from_rows("Mean during the intervention", self._of_modalities())] if self.modalities else []),
        ]

    def _of_modalities(self) -> list[dict[str, Value]]:
        """Rows of a table."""
        main = self.task.main_error
        change = main.factor * self.modality_distance[self.during].mean(0)
        means = {f"change of its update, {main.unit}".rstrip(", "): change}
        if self.effective_weights is not None and self.counterfactual_weights is not None:
            means |= {
                "effective weight": self.effective_weights[self.during].mean(0),
                "effective weight with intervention": self.counterfactual_weights[self.during].mean(0),
            }
        return [
            {"modality": m, **{name: values[k] for name, values in means.items()}}
            for k, m in enumerate(self.modalities)
        ]

    def curves(self) -> list[Curve]:
        chart = "Distance between original and counterfactual estimates"
        main = self.task.main_error
        scale, unit = main.factor, main.unit
        curves = [Curve("fused", scale * self.distance, chart, unit, "fused")]
        for k, m in enumerate(self.modalities if len(self.modalities) > 1 else ()):
            if np.isfinite(self.modality_distance[:, k]).any():
                curves.append(Curve(layer_label(m), scale * self.modality_distance[:, k], chart, unit, m))
        curves.append(
            Curve(
                "fused",
                self.sigmas,
                "Distance in standard deviations of the original run",
                "",
                "fused",
                (0.0, RECOVERED),
            )
        )
        for layer_error, name in ((self.error, "original"), (self.counterfactual_error, "with intervention")):
            curves.append(Curve(name, scale * layer_error, "Error", unit, "fused"))
        if self.effective_weights is not None and self.counterfactual_weights is not None:
            for k, m in enumerate(self.modalities):
                both = ((self.effective_weights, m), (self.counterfactual_weights, f"{m} with intervention"))
                for weights, name in both:
                    curves.append(Curve(name, weights[:, k], "Effective weights", "", m))
        task = self.task
        units, factors = display_units(task)
        for i, component in enumerate(task.components):
            for values, name, layer in (
                (self.truth, "truth", "truth"),
                (task.near(self.original, self.truth), "original", "fused"),
                (task.near(self.counterfactual, self.truth), "with intervention", "fused"),
            ):
                curves.append(Curve(name, factors[i] * values[:, i], component.label, units[i], layer))
        return curves

    def bands(self) -> dict[str, NDArray[np.bool_]]:
        steps = np.arange(len(self.distance))
        return {"contact": self.contact, "intervention": (steps >= self.first) & (steps < self.to)}


def compare(original: Trace, counterfactual: Trace, intervention: Intervention) -> Counterfactual:
    """Compare the traces of a run and of the same run with an intervention.

    Raises BadInput for traces of different length.
    """
    if len(original) != len(counterfactual):
        raise BadInput(f"traces of {len(original)} and {len(counterfactual)} steps are not from one episode")
    task = original.task
    difference = task.difference(means(counterfactual), means(original))
    on_map = task.main_error.norm(difference)
    fused = difference[:, -1]
    weights = [
        None if trace.effective_weights is None else trace.effective_weights.mean(-1, dtype=np.float64)
        for trace in (original, counterfactual)
    ]
    sigmas = _mahalanobis(original, fused)
    return Counterfactual(
        task=task,
        filter=original.filter,
        modalities=original.modalities,
        intervention=str(intervention),
        first=intervention.first,
        to=intervention.to,
        truth=original.episode.states.astype(np.float64),
        original=original.estimate_mean.astype(np.float64),
        counterfactual=counterfactual.estimate_mean.astype(np.float64),
        distance=on_map[:, -1],
        modality_distance=on_map[:, :-1],
        sigmas=sigmas,
        divergence=_divergence(original, counterfactual, fused),
        error=main_error(original)[:, -1],
        counterfactual_error=main_error(counterfactual)[:, -1],
        effective_weights=weights[0],
        counterfactual_weights=weights[1],
        contact=original.episode.contact.astype(bool),
        time=original.episode.time,
        recovery=_recovery_step(sigmas, intervention.to),
    )


def _mahalanobis(original: Trace, difference: Array) -> Array:
    """(T,): differences (T, n) of the fused estimate in standard deviations of the original."""
    if original.has_covariance:
        covariance = covariances(original)[:, -1]
    else:
        covariance = np.diag(np.square(errors(original)[:, -1]).mean(0))[None]
    white = np.linalg.solve(covariance, difference[..., None])[..., 0]
    return np.sqrt(np.maximum(np.einsum("tn,tn->t", difference, white) / difference.shape[-1], 0.0))


def _divergence(original: Trace, counterfactual: Trace, difference: Array) -> Array:
    """(T,) nats: ``KL(N(m, S) || N(m', S')) = (tr S'^-1 S + d^T S'^-1 d - n + ln det S' - ln det S) / 2``."""
    if not original.has_covariance:
        return np.full(len(original), np.nan)
    s, s_counterfactual = covariances(original)[:, -1], covariances(counterfactual)[:, -1]
    both = np.concatenate([s, difference[..., None]], axis=-1)
    solved = np.linalg.solve(s_counterfactual, both)
    n = s.shape[-1]
    trace_term = np.einsum("tii->t", solved[..., :n])
    quadratic = np.einsum("tn,tn->t", difference, solved[..., n])
    with np.errstate(invalid="ignore"):  # unknown covariances are NaN
        volume = np.linalg.slogdet(s_counterfactual).logabsdet - np.linalg.slogdet(s).logabsdet
    return 0.5 * (trace_term + quadratic - n + volume)


def _recovery_step(sigmas: Array, to: int) -> int | None:
    """First step from ``to`` on from which all values are at most ``RECOVERED``."""
    exceeded = np.flatnonzero(sigmas[to:] > RECOVERED)
    step = to + (int(exceeded[-1]) + 1 if len(exceeded) else 0)
    return step if step < len(sigmas) else None

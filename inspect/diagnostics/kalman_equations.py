"""Jacobians and updates of an external Kalman filter, against finite differences of its own functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task, display_name
from beliefscope.datasets.text import capitalised, percent, plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.kalman_updates import (
    Updates,
    component_slopes,
    correction_slopes,
    expected_updates,
)
from beliefscope.inspect.diagnostics.repeated_steps import (
    RepeatedSteps,
    known_median,
    repeat_steps,
    weights_of,
    why_not,
)
from beliefscope.inspect.diagnostics.views import Array, Table
from beliefscope.inspect.statistics.innovations import channel_names
from beliefscope.inspect.trace import Trace

EPISODES = 8
"""Maximum number of episodes whose steps are repeated: they use the same functions."""

WRONG = 0.2
"""Smallest error of a wrong equation: that of a factor of 1.1 in a Jacobian. Exact ones have less than 0.02."""

OPPOSITE = -0.2
"""Largest slope of corrections that have the wrong sign: exact filters have more than 0.7."""

LACKING = -0.02
"""Largest eigenvalue of a noise covariance, relative to the whole one, that cannot be."""


@dataclass(frozen=True)
class KalmanEquations(Diagnostic):
    """Result of ``check_equations``, with n components, K modalities and m channels.

    Relative errors are the smallest ones of the nearly linear steps of an episode, since filters that do not linearise
    differ from derivatives where their beliefs are wide; and medians over episodes.

    Attributes:
        task, filter, trajectories, steps: numbers of episodes and of steps that were repeated in all of them.
        modalities: names; empty without innovations. channels: K times m names.
        dynamics: (n,) relative error, of the growth of the predicted covariance with the variance of a component.
        measurement: (K,) relative error, of the growth of the innovations' covariance.
        columns: (n + 1, K) errors as ``measurement`` with the variance of one component, and of all together.
        slopes: (K,) median ``correction_slopes``, from -1 to 1.
        covariance, correction: (K,) relative errors of the reduction of the covariance and of the correction of the
            mean, in steps with the modality.
        process_noise: (n,) standard deviations of Q per step, SI units; NaN if unknown. process_lack: smallest
            eigenvalue of Q, relative to the predicted covariance.
        measurement_noise: (K, m) standard deviations of R; NaN for absent channels. measurement_lack: (K,) as
            ``process_lack``, relative to S.
    """

    task: Task
    filter: str
    trajectories: int
    steps: int
    modalities: tuple[str, ...]
    channels: tuple[tuple[str, ...], ...]
    dynamics: Array
    measurement: Array
    columns: Array
    slopes: Array
    covariance: Array
    correction: Array
    process_noise: Array
    process_lack: float
    measurement_noise: Array
    measurement_lack: Array

    @property
    def alarms(self) -> tuple[str, ...]:
        jacobians = (*self._of_dynamics(), *self._of_measurements())
        return jacobians or tuple(self._of_covariances())  # which a wrong Jacobian changes as well

    def _of_dynamics(self) -> list[str]:
        if not np.nanmax(self.dynamics, initial=0.0) >= WRONG:
            return []
        i = int(np.nanargmax(self.dynamics))
        name, error = display_name(self.task.components[i].name), percent(self.dynamics[i])
        return [f"the Jacobian of the dynamics differs from finite differences by {error} in column {name}"]

    def _of_measurements(self) -> list[str]:
        texts = []
        for k, (name, error, slope) in enumerate(zip(self.modalities, self.measurement, self.slopes, strict=True)):
            if error >= WRONG:
                text = f"the Jacobian of {display_name(name)} differs from finite differences by {percent(error)}"
                texts.append(f"{text}{self._part(k)}")
            elif slope <= OPPOSITE:
                texts.append(f"corrections with {display_name(name)} have the wrong sign (slope {slope:z.2f})")
        return texts

    def _of_covariances(self) -> list[str]:
        texts = []
        if self.process_lack <= LACKING:
            texts.append("the predicted covariance is smaller than F P Fᵀ, as if Q were negative")
        for name, lack in zip(self.modalities, self.measurement_lack, strict=True):
            if lack <= LACKING:
                texts.append(f"S of {display_name(name)} is smaller than H P Hᵀ, as if R were negative")
        for errors, quantity, law in (
            (self.covariance, "reduction of the covariance", "K H P"),
            (self.correction, "correction of the mean", "K times the innovation"),
        ):
            names = [display_name(name) for name, error in zip(self.modalities, errors, strict=True) if error >= WRONG]
            if names:
                largest = percent(np.nanmax(errors))
                texts.append(f"in updates with {', '.join(names)}, the {quantity} differs from {law} by {largest}")
        return texts

    def _part(self, k: int) -> str:
        """The part of H of a modality that is wrong, if it is not all of it."""
        errors = self.columns[:-1, k]
        names = [display_name(component.name) for component in self.task.components]
        wrong = [name for name, error in zip(names, errors, strict=True) if error >= WRONG]
        if not wrong:  # the products of each column with itself are right
            return ", by the sign of a column"
        return "" if len(wrong) == np.isfinite(errors).sum() else ", for " + ", ".join(wrong)

    @property
    def verdict(self) -> str:
        if self.alarms:
            return " ".join(f"{capitalised(text)}." for text in self.alarms)
        errors = np.array([*self.dynamics, *self.measurement, *self.covariance, *self.correction])
        largest = f"{percent(np.nanmax(errors), '.2g')} or less" if np.isfinite(errors).any() else "unknown"
        return f"Jacobians and updates agree with finite differences of the filter's own functions (error {largest})."

    def tables(self) -> list[Table]:
        components, units = self.task.components, {c.name: c.conversion for c in self.task.vector_channels()}
        modalities = [display_name(name) for name in self.modalities]
        measurements = zip(modalities, self.measurement, self.columns.T, self.slopes, strict=True)
        rows = [
            ("dynamics", None, *map(_percent, self.dynamics), None, None),
            *((name, _percent(error), *map(_percent, columns), slope) for name, error, columns, slope in measurements),
        ]
        names = (f"{display_name(component.name)}, %" for component in components)
        heads = ("Jacobian of", "error, %", *names, "together, %", "slope of corrections")
        note = (
            f"{plural(self.steps, 'step')} of {plural(self.trajectories, 'episode')}, repeated with a larger variance "
            "of each component, and of all together: it adds F Fᵀ to the predicted covariance, and H F Fᵀ Hᵀ to "
            "that of the innovations. Errors are differences from these products by finite differences, relative to "
            "them. A factor f in a Jacobian has the error |f² - 1|; exact ones have less than 2 %. "
            "Corrections have a slope of about 1; if it is -1, their sign is wrong."
        )
        noise = [
            (f"process, {display_name(c.name)}", value, c.conversion)
            for c, value in zip(components, self.process_noise, strict=True)
        ] + [
            (channel if channel.startswith(name) else f"{name}, {channel}", value, units.get(channel, ("", 1.0)))
            for name, channels, values in zip(self.modalities, self.channels, self.measurement_noise, strict=True)
            for channel, value in zip(channels, values, strict=True)
        ]
        known = [(name, factor * value, unit) for name, value, (unit, factor) in noise if not np.isnan(value)]
        tables = [Table("Jacobians against finite differences", heads, rows, note)]
        if modalities:
            heads = ("steps with", "covariance error, %", "mean error, %")
            updates = zip(modalities, map(_percent, self.covariance), map(_percent, self.correction), strict=True)
            tables.append(Table("Updates against K = P Hᵀ S⁻¹", heads, list(updates)))
        note = "Q = P - F P Fᵀ per step, and R = S - H P Hᵀ. Readings have the units of the task's channels."
        heads = ("noise", "standard deviation", "unit")
        return [*tables, Table("Noise that the covariances contain", heads, known, note)]


def _percent(value: float) -> float:
    return round(100.0 * value, 2)


def jacobian_statistics(trace: Trace, checkpoint: ExternalFilter) -> dict[str, float]:
    """``KIND/SUBJECT/all`` -> value, of a Kalman filter whose steps can be repeated; none of others.

    Some steps are repeated from other beliefs. With a variance of component i that is larger by d, the covariance of
    the prediction is larger by ``E = d F_i F_i^T``, with column i of the filter's F, and the covariance S of the
    innovations by ``H E H^T``; also with one update after another, since a small d leaves the gains almost the same.

    ``prediction jacobian``, by component: relative difference of E from its value by the derivative of the predicted
    mean. ``measurement jacobian``, by modality: that of ``H E H^T`` from its value by that of the innovations.
    ``correction slope``, by modality: of ``correction_slopes``. ``component correction``: ``component_slopes``.
    ``covariance update``: ``Updates.covariance_slope`` of
    nearly linear steps, of filters without fusion weights.
    """
    has_truth = bool(np.isfinite(trace.episode.states).all())
    repeated = None if why_not(trace, checkpoint) else repeat_steps(trace, checkpoint, at_truth=has_truth)
    if repeated is None:
        return {}
    components = [component.name for component in trace.task.components]
    columns = {"prediction jacobian": (components, known_median(repeated.dynamics_errors()))}
    if trace.innovation is not None:
        columns["measurement jacobian"] = (list(trace.modalities), known_median(repeated.measurement_errors()))
        updates = expected_updates(repeated)
        columns["correction slope"] = (list(trace.modalities), correction_slopes(repeated, updates))
        columns["component correction"] = (components, component_slopes(repeated, updates))
        if trace.weights is None:
            linear = repeated.linear()
            slope = math.nan if linear is None else expected_updates(linear).covariance_slope
            columns["covariance update"] = ([""], np.array([slope]))
    return {
        f"{kind}/{name}/all": float(value)
        for kind, (names, values) in columns.items()
        for name, value in zip(names, values, strict=True)
    }


def check_equations(traces: Sequence[Trace], checkpoint: ExternalFilter) -> KalmanEquations:
    """Compare the equations of a filter with its own functions, over the first episodes.

    Raises BadInput if its steps cannot be repeated.
    """
    all_repeated = [repeat_steps(trace, checkpoint) for trace in traces[:EPISODES]]
    if all(steps is None for steps in all_repeated):
        raise BadInput("steps of the filter cannot be repeated: they depend on more than its belief and its inputs")
    repeated = [linear for steps in all_repeated if steps is not None and (linear := steps.linear()) is not None]
    if not repeated:
        raise BadInput("the filter's beliefs are too wide for a comparison with finite differences")

    def errors(measure: Callable[[RepeatedSteps], Array]) -> Array:
        return known_median(np.stack([np.fmin.reduce(measure(steps)) for steps in repeated]))

    first, updates = traces[0], [expected_updates(steps) for steps in repeated]
    process = np.concatenate([steps.process_noise() for steps in repeated])
    channels = [] if first.innovation is None else channel_names(first, first.innovation)
    return KalmanEquations(
        task=first.task,
        filter=first.filter,
        trajectories=len(repeated),
        steps=sum(len(steps.steps) for steps in repeated),
        modalities=tuple(first.modalities[: len(channels)]),
        channels=tuple(map(tuple, channels)),
        measurement=errors(RepeatedSteps.measurement_errors),
        columns=errors(RepeatedSteps.measurement_errors_by_component),
        slopes=known_median(np.stack([*map(correction_slopes, repeated, updates)])),
        dynamics=errors(RepeatedSteps.dynamics_errors),
        process_noise=np.sqrt(np.maximum(known_median(np.diagonal(process, axis1=-2, axis2=-1)), 0.0)),
        process_lack=float(_lack(process, np.concatenate([steps.covariance[:, 0] for steps in repeated]))),
        **_of_updates(repeated, updates, has_weights=first.weights is not None),
    )


def _of_updates(repeated: Sequence[RepeatedSteps], updates: Sequence[Updates], has_weights: bool) -> dict[str, Any]:
    """The fields about updates. Those of filters with fusion weights are no Kalman updates."""
    size = np.concatenate([steps.size[:, 0] for steps in repeated])
    noise = np.concatenate([update.noise for update in updates])
    variance, whole = (np.diagonal(x, axis1=-2, axis2=-1) for x in (noise, size))
    variance = np.where(whole > 0.0, np.maximum(variance, 0.0), np.nan)
    covariance, correction = (
        known_median(np.stack([np.fmin.reduce(errors) for errors in each]))
        for each in zip(*((u.covariance_error, u.correction_error) for u in updates), strict=True)
    )
    return {
        "covariance": np.full_like(covariance, np.nan) if has_weights else covariance,
        "correction": np.full_like(correction, np.nan) if has_weights else correction,
        "measurement_noise": np.sqrt(known_median(variance)),
        "measurement_lack": _lack(noise, size),
    }


def _lack(noise: Array, whole: Array) -> Array:
    """(...,) median over the first axis of the smallest eigenvalue of covariances, relative to the whole ones."""
    weights = weights_of(whole)
    scaled = weights * noise
    known = np.asarray(np.isfinite(scaled).all((-2, -1)) & (weights > 0.0).any((-2, -1)))
    smallest = np.linalg.eigvalsh(np.where(known[..., None, None], scaled, 0.0)).min(-1, initial=np.inf)
    return known_median(np.where(known, smallest, np.nan))


def wrong_equations(traces: Sequence[Trace], checkpoint: Checkpoint) -> tuple[str, ...]:
    """The alarms of ``check_equations``; none where it does not apply."""
    if not isinstance(checkpoint, ExternalFilter) or any(why_not(trace, checkpoint) for trace in traces):
        return ()
    with suppress(BadInput):
        return check_equations(traces, checkpoint).alarms
    return ()


ENTRY = Entry(
    name="equations",
    title="Kalman equations",
    question="Do the Jacobians and updates of an external Kalman filter follow from its own functions?",
    run=check_equations,
    why_not=why_not,
    needs="filter",
)

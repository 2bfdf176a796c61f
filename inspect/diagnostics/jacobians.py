"""Jacobians of an external Kalman filter, against finite differences of its own functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import display_name
from beliefscope.datasets.text import percent, plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.repeated_steps import RepeatedSteps, known_median, repeat_steps, why_not
from beliefscope.inspect.diagnostics.views import Array, Table
from beliefscope.inspect.trace import Trace

EPISODES = 8
"""Maximum number of episodes whose steps are repeated: they use the same functions."""

WRONG = 0.2
"""Smallest error of a wrong Jacobian: that of a factor of 1.1. Exact ones have less than 0.02."""

OPPOSITE = -0.2
"""Largest slope of corrections that have the wrong sign: exact filters have more than 0.7."""


@dataclass(frozen=True)
class Jacobians(Diagnostic):
    """Result of ``jacobians_of``, with n components and K modalities.

    Relative errors are the smallest ones of the steps of an episode, since filters that do not linearise differ from
    derivatives where their beliefs are wide; and medians over episodes.

    Attributes:
        filter, trajectories, steps: numbers of episodes and of steps that were repeated in all of them.
        components, modalities: names.
        dynamics: (n,) relative error, of the growth of the predicted covariance with the variance of a component.
        measurement: (K,) relative error, of the growth of the innovations' covariance; NaN without innovations.
        columns: (n + 1, K) errors as ``measurement`` with the variance of one component, and of all together.
        slopes: (K,) median slope of the corrections on ``P+ H^T R^-1 nu``, from -1 to 1; NaN without innovations.
    """

    filter: str
    trajectories: int
    steps: int
    components: tuple[str, ...]
    modalities: tuple[str, ...]
    dynamics: Array
    measurement: Array
    columns: Array
    slopes: Array

    @property
    def alarms(self) -> tuple[str, ...]:
        texts = []
        if np.nanmax(self.dynamics, initial=0.0) >= WRONG:
            i = int(np.nanargmax(self.dynamics))
            name = display_name(self.components[i])
            error = percent(self.dynamics[i])
            texts.append(f"the Jacobian of the dynamics differs from finite differences by {error} in column {name}")
        for k, (name, error, slope) in enumerate(zip(self.modalities, self.measurement, self.slopes, strict=True)):
            if error >= WRONG:
                text = f"the Jacobian of {display_name(name)} differs from finite differences by {percent(error)}"
                texts.append(f"{text}{self._part(k)}")
            elif slope <= OPPOSITE:
                texts.append(f"corrections with {display_name(name)} have the wrong sign (slope {slope:.2f})")
        return tuple(texts)

    @property
    def verdict(self) -> str:
        if self.alarms:
            return " ".join(f"{text[0].upper()}{text[1:]}." for text in self.alarms)
        errors = np.concatenate([self.dynamics, self.measurement])
        largest = f"{percent(np.nanmax(errors), '.2g')} or less" if np.isfinite(errors).any() else "an unknown share"
        return f"All Jacobians agree with finite differences of the filter's own functions (error {largest})."

    def _part(self, k: int) -> str:
        """The part of H of a modality that is wrong, if it is not all of it."""
        errors = self.columns[:-1, k]
        wrong = [display_name(name) for name, error in zip(self.components, errors, strict=True) if error >= WRONG]
        if not wrong:  # the products of each column with itself are right
            return ", by the sign of a column"
        return "" if len(wrong) == np.isfinite(errors).sum() else ", for " + ", ".join(wrong)

    def tables(self) -> list[Table]:
        rows = [
            ("dynamics", None, *map(_percent, self.dynamics), None, None),
            *(
                (display_name(name), _percent(error), *map(_percent, columns), _number(slope))
                for name, error, columns, slope in zip(
                    self.modalities, self.measurement, self.columns.T, self.slopes, strict=True
                )
            ),
        ]
        components = (f"{display_name(name)}, %" for name in self.components)
        heads = ("Jacobian of", "error, %", *components, "together, %", "slope of corrections")
        note = (
            f"{plural(self.steps, 'step')} of {plural(self.trajectories, 'episode')}, repeated with a larger variance "
            "of each component, and of all together: it adds F F^T to the predicted covariance, and H F F^T H^T to "
            "that of the innovations. Errors are differences from these products by finite differences, relative to "
            "them. A factor f in a Jacobian has the error |f^2 - 1|; exact ones have less than 2 %, and filters "
            "that do not linearise, such as UKFs, more where their beliefs are wide. "
            "Corrections have a slope of about 1; if it is -1, their sign is wrong."
        )
        return [Table("Jacobians against finite differences", heads, tuple(rows), note)]


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _percent(value: float) -> float | None:
    return _number(round(100.0 * value, 2))


def jacobian_statistics(trace: Trace, checkpoint: ExternalFilter) -> dict[str, float]:
    """``KIND/SUBJECT/all`` -> value, of a Kalman filter whose steps can be repeated; none of others.

    Some steps are repeated from other beliefs. With a variance of component i that is larger by d, the covariance of
    the prediction is larger by ``E = d F_i F_i^T``, with column i of the filter's F, and the covariance S of the
    innovations by ``H E H^T``; also with one update after another, since a small d leaves the gains almost the same.

    ``prediction jacobian``, by component: relative difference of E from its value by the derivative of the predicted
    mean. ``measurement jacobian``, by modality: that of ``H E H^T`` from its value by that of the innovations.
    ``correction slope``, by modality: slope of the corrections on ``P+ H^T R^-1 nu``, from -1 to 1, as these products
    do not show the sign of the filter's H. It is 1 with joint updates, and nearly so with others.
    """
    repeated = None if why_not(trace, checkpoint) else repeat_steps(trace, checkpoint)
    if repeated is None:
        return {}
    components = [component.name for component in trace.task.components]
    columns = {"prediction jacobian": (components, known_median(repeated.dynamics_errors()))}
    if trace.innovation is not None:
        columns["measurement jacobian"] = (list(trace.modalities), known_median(repeated.measurement_errors()))
        columns["correction slope"] = (list(trace.modalities), repeated.slopes())
    return {
        f"{kind}/{name}/all": float(value)
        for kind, (names, values) in columns.items()
        for name, value in zip(names, values, strict=True)
    }


def shows_wrong_jacobians(statistics: Mapping[str, Array]) -> bool:
    """Whether ``jacobian_statistics`` of several episodes, by name, are those of a wrong Jacobian in most of them.

    They may also be those of a filter that does not linearise, which ``jacobians_of`` decides.
    """
    for name, values in statistics.items():
        kind = name.partition("/")[0]
        median = float(known_median(values))
        if (kind.endswith(" jacobian") and median >= WRONG) or (kind == "correction slope" and median <= OPPOSITE):
            return True
    return False


def jacobians_of(traces: Sequence[Trace], checkpoint: ExternalFilter) -> Jacobians:
    """Compare the Jacobians of a filter with finite differences, over the first episodes.

    Raises BadInput if its steps cannot be repeated.
    """
    all_repeated = [repeat_steps(trace, checkpoint) for trace in traces[:EPISODES]]
    repeated = [steps for steps in all_repeated if steps is not None]
    if not repeated:
        raise BadInput("steps of the filter cannot be repeated: they depend on more than its belief and its inputs")

    def errors(measure: Callable[[RepeatedSteps], Array]) -> Array:
        return known_median(np.stack([np.fmin.reduce(measure(steps)) for steps in repeated]))

    first = traces[0]
    components, modalities = tuple(component.name for component in first.task.components), tuple(first.modalities)
    measurement, slopes, columns = np.empty(0), np.empty(0), np.empty((len(components) + 1, 0))
    if first.innovation is None:
        modalities = ()
    else:
        measurement = errors(RepeatedSteps.measurement_errors)
        columns = errors(RepeatedSteps.measurement_errors_by_component)
        slopes = known_median(np.stack([steps.slopes() for steps in repeated]))
    return Jacobians(
        filter=first.filter,
        trajectories=len(repeated),
        steps=sum(len(steps.steps) for steps in repeated),
        components=components,
        modalities=modalities,
        dynamics=errors(RepeatedSteps.dynamics_errors),
        measurement=measurement,
        columns=columns,
        slopes=slopes,
    )


def wrong_jacobians(traces: Sequence[Trace], checkpoint: Checkpoint) -> tuple[str, ...]:
    """The alarms of ``jacobians_of``; none where it does not apply."""
    if not isinstance(checkpoint, ExternalFilter) or any(why_not(trace, checkpoint) for trace in traces):
        return ()
    with suppress(BadInput):
        return jacobians_of(traces, checkpoint).alarms
    return ()


ENTRY = Entry(
    name="jacobians",
    title="Jacobians",
    question="Do the Jacobians of an external Kalman filter match its own functions?",
    run=jacobians_of,
    why_not=why_not,
    needs="checkpoint",
)

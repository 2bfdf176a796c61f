"""One step of a run as a differentiable function of what its sensors say, all else as it was."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from beliefscope.datasets.errors import one_of
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence, Gaussian, Particles, StepTrace
from beliefscope.filters.evaluate import UNITS
from beliefscope.filters.models.common_random_numbers import Common
from beliefscope.filters.models.pf import ParticleFilter
from beliefscope.inspect.diagnostics.base import Array
from beliefscope.inspect.diagnostics.shapley import seen
from beliefscope.inspect.traces.replay import Edit, Replay, repeated

SHOWN = {"effector_position": ("cm", 100.0), "force": ("N", 1.0), "torque": ("N m", 1.0)}
"""Key of an observation -> unit in which its channels are shown, and the factor to it. Of others none is known."""


@dataclass(frozen=True)
class Channel:
    """One number of a modality: ``force y``. unit, factor: in which it is shown, and from the unit inside."""

    name: str
    unit: str
    factor: float


def channel_names(task: Task, modalities: Iterable[str]) -> dict[str, tuple[Channel, ...]]:
    """The channels of those modalities that are not pictures."""
    found = {}
    for modality in modalities:
        keys = {key: task.observations[key] for key in task.modalities[modality]}
        if all(len(shape) == 1 for shape in keys.values()):
            found[modality] = tuple(
                Channel(f"{key} {axis}".strip(), *SHOWN.get(key, ("", 1.0)))
                for key, (size,) in keys.items()
                for axis in ([""] if size == 1 else "xyz"[:size] if size <= 3 else map(str, range(size)))
            )
    return found


Value = Callable[[StepTrace, Evidence], Tensor]
"""What a batch of steps gave to one number each, (B,)."""


@dataclass(frozen=True)
class Target:
    """A number that the step gives, as a function of the inputs: batches (B, ...), one a modality, to (B,).

    Attributes:
        name: as asked for. unit, factor: in which it is shown, and from the unit inside.
    """

    name: str
    unit: str
    factor: float
    value: Value
    moment: Moment

    def __call__(self, *inputs: Tensor) -> Tensor:
        value = self.value(*self.moment.run(*inputs))
        # What has no part in the target has a gradient too: zero.
        return value + sum(0.0 * one.flatten(1).sum(1) for one in inputs)


class Moment:
    """One step of a replayed run, from the belief before it and with its random numbers.

    Attributes:
        modalities: that the filter sees. inputs: of each, (1, H, W) gray from 0 to 255 or (1, d) SI units, float.
        targets: what can be asked of it, by name.
    """

    def __init__(self, replay: Replay, step: int, at: Literal["truth", "estimate"] = "truth") -> None:
        """at: where the log-likelihood is taken."""
        filter_ = replay.checkpoint.filter
        self.replay, self.step, self.filter = replay, step, filter_
        self.modalities = seen(filter_)
        dtype = filter_.statistics.mean_std("state")[0].dtype
        self.inputs = tuple(replay.batch.observations[name][step].to(dtype) for name in self.modalities)
        truth, estimate = replay.batch.states[step, 0], replay.original.estimate_mean[step]
        place = truth if at == "truth" else torch.from_numpy(estimate)
        self.place = filter_.statistics.standardise("state", place)
        edits = map(Edit.of, replay.original.settings.get("edits", []))
        self._edits = [Edit(0, 1, weights=e.weights) for e in edits if e.weights and e.first <= step < e.to]
        self.targets = {target.name: target for target in self._targets()}

    def target(self, name: str) -> Target:
        """Raises BadInput for one that this filter does not have."""
        if name not in self.targets:
            raise one_of(f"target of filter {self.replay.checkpoint.name!r}", name, self.targets)
        return self.targets[name]

    def baseline(self, black: bool) -> tuple[Tensor, ...]:
        """Inputs at the training mean; pictures ``black`` or of the training set's mean gray."""
        return tuple(
            torch.zeros_like(values)
            if black and values.ndim == 3
            else self.filter.statistics.mean_std(name)[0].expand_as(values)
            for name, values in zip(self.modalities, self.inputs, strict=True)
        )

    def named(self, values: tuple[Tensor, ...]) -> Mapping[str, Array]:
        """Modality -> what belongs to it, (1, ...) to (...)."""
        return {name: one[0].detach().double().numpy() for name, one in zip(self.modalities, values, strict=True)}

    def run(self, *inputs: Tensor) -> tuple[StepTrace, Evidence]:
        """The step with other inputs, (B, ...) each. What it draws does not depend on them."""
        batch, count, at = self.replay.batch, len(inputs[0]), slice(self.step, self.step + 1)

        def wide(values: Tensor) -> Tensor:
            return values[at].expand(-1, count, *values.shape[2:])

        seen_now = {name: wide(values) for name, values in batch.observations.items()}
        seen_now |= {name: values.unsqueeze(0) for name, values in zip(self.modalities, inputs, strict=True)}
        evidence = self.filter.encode(
            Batch(
                observations=seen_now,
                controls=wide(batch.controls),
                states=wide(batch.states),
                contact=wide(batch.contact),
                previous=batch.previous.expand(count, -1),
            )
        )
        for edit in self._edits:
            evidence = self.replay.weighed(evidence, edit)
        belief = repeated(self.replay.beliefs[self.step], count)
        _, trace = self.filter.step(belief, evidence[0], self.replay.generator(self.step, Common))
        return trace, evidence[0]

    def _targets(self) -> Iterable[Target]:
        for i, component in enumerate(self.filter.task.components):
            yield Target(component.name, *UNITS[component.unit], self._component(i), self)
        if self.filter.architecture.kind == "lstm":
            return
        for k, name in enumerate(self.filter.names):
            yield Target(f"log-likelihood:{name}", "nats", 1.0, self._log_likelihood(k), self)
        if self.replay.evidence.log_weights is not None:
            for k, name in enumerate(self.filter.names):
                yield Target(f"beta:{name}", "", 1.0, self._beta(k), self)

    def _component(self, i: int) -> Value:
        """Of the fused estimate, m or rad: a particle filter's weighted mean, before it resamples."""
        return lambda trace, evidence: self.filter.statistics.state_to_si(trace.estimate.mean)[:, i]

    def _beta(self, k: int) -> Value:
        """As the network gave it, its mean over components."""

        def value(trace: StepTrace, evidence: Evidence) -> Tensor:
            assert evidence.log_weights is not None
            return evidence.log_weights[:, k].exp().mean(-1)

        return value

    def _log_likelihood(self, k: int) -> Value:
        """``ln p_k(z | x) - ln p_k(z)``, nats: what the observation adds to the log density at ``place``.

        The evidence p_k(z) is under the predicted belief, so that what a particle filter's unnormalised likelihood is
        worth does not depend on its constant. Of a Kalman filter it is ln posterior - ln predicted, by Bayes' rule.
        """

        def of_particles(trace: StepTrace, evidence: Evidence) -> Tensor:
            assert isinstance(self.filter, ParticleFilter)
            assert isinstance(trace.predicted, Particles)
            assert trace.log_likelihood is not None
            place = self.place.expand(len(trace.log_likelihood), 1, -1)
            there = self.filter.log_likelihood(evidence, place)[:, k, 0]
            return there - torch.logsumexp(trace.predicted.log_weights + trace.log_likelihood[:, k], dim=-1)

        def of_kalman(trace: StepTrace, evidence: Evidence) -> Tensor:
            assert isinstance(trace.predicted, Gaussian)
            assert trace.modality is not None
            posterior, predicted = (
                MultivariateNormal(belief.mean[:, k].double(), belief.covariance[:, k].double()).log_prob(self.place)
                for belief in (trace.modality, trace.predicted)
            )
            return posterior - predicted

        return of_particles if isinstance(self.filter, ParticleFilter) else of_kalman

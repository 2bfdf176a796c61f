"""One step of a run as a differentiable function of its observations."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from beliefscope.datasets.errors import check_name
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence, Gaussian, Particles, StepTrace
from beliefscope.filters.models.common_random_numbers import Common
from beliefscope.filters.models.pf import ParticleFilter
from beliefscope.filters.models.sequence import SequenceModel
from beliefscope.filters.subsets import input_modalities
from beliefscope.inspect.traces.replay import Intervention, Replay, repeat_belief


def channels_of(task: Task, modalities: Iterable[str]) -> dict[str, tuple[Component, ...]]:
    """Modality -> channels, such as ``force y``, for modalities that are not images."""
    channels = {}
    for modality in modalities:
        keys = {key: task.observations[key] for key in task.modalities[modality]}
        if all(len(shape) == 1 for shape in keys.values()):
            channels[modality] = tuple(task.channel(key, i) for key, (size,) in keys.items() for i in range(size))
    return channels


Value = Callable[[StepTrace, Evidence], Tensor]
"""Function of a batch of steps to one number each, (B,)."""


@dataclass(frozen=True)
class Target:
    """An output of the step as a function of its inputs: batches (B, ...), one per modality, to (B,).

    Attributes:
        name: target name.
        unit, factor: display unit and conversion factor.
    """

    name: str
    unit: str
    factor: float
    value: Value
    step: SingleStep

    def __call__(self, *inputs: Tensor) -> Tensor:
        value = self.value(*self.step.run(*inputs))
        # Inputs without effect on the target get a zero gradient.
        return value + sum(0.0 * x.flatten(1).sum(1) for x in inputs)


class SingleStep:
    """One step of a replayed run, from the belief before it and with its random numbers.

    Attributes:
        modalities: the filter's input modalities.
        inputs: observation of each modality, (1, H, W) gray from 0 to 255 or (1, d) SI units, float.
        targets: available targets by name.
    """

    def __init__(self, replay: Replay, step: int, at: Literal["truth", "estimate"] = "truth") -> None:
        """at: position at which the log-likelihood is evaluated."""
        filter_ = replay.checkpoint.filter
        self.replay, self.step, self.filter = replay, step, filter_
        self.modalities = input_modalities(filter_)
        dtype = filter_.statistics.mean_std("state")[0].dtype
        self.inputs = tuple(replay.batch.observations[name][step].to(dtype) for name in self.modalities)
        truth, estimate = replay.batch.states[step, 0], replay.original.estimate_mean[step]
        place = truth if at == "truth" else torch.from_numpy(estimate)
        self.place = filter_.statistics.standardise("state", place)
        given = map(Intervention.from_json, replay.original.settings.get("edits", []))
        manual = (intervention.weights for intervention in given if intervention.first <= step < intervention.to)
        self._interventions = [Intervention(0, 1, weights=weights) for weights in manual if weights]
        self.targets = {target.name: target for target in self._targets()}

    def target(self, name: str) -> Target:
        """Return a target. Raises BadInput for a target that the filter does not have."""
        check_name(f"target of filter {self.replay.checkpoint.name!r}", name, self.targets)
        return self.targets[name]

    def baseline(self, black: bool) -> tuple[Tensor, ...]:
        """Inputs at the training mean; images ``black`` or at the training set's mean gray."""
        return tuple(
            torch.zeros_like(values)
            if black and values.ndim == 3
            else self.filter.statistics.mean_std(name)[0].expand_as(values)
            for name, values in zip(self.modalities, self.inputs, strict=True)
        )

    @property
    def means(self) -> tuple[Tensor, ...]:
        """Training means of the inputs."""
        return self.baseline(black=False)

    def run(self, *inputs: Tensor) -> tuple[StepTrace, Evidence]:
        """Run the step with other inputs, (B, ...) each, and equal random numbers."""
        batch, count = self.replay.batch, len(inputs[0])
        at = slice(max(0, self.step - self.filter.history), self.step + 1)

        def expand(values: Tensor) -> Tensor:
            return values[at].expand(-1, count, *values.shape[2:])

        observations = {name: expand(values) for name, values in batch.observations.items()}
        for name, values in zip(self.modalities, inputs, strict=True):
            observations[name] = torch.cat([observations[name][:-1].to(values.dtype), values.unsqueeze(0)])
        window = Batch(
            observations=observations,
            controls=expand(batch.controls),
            states=expand(batch.states),
            contact=expand(batch.contact),
            previous=batch.previous.expand(count, -1),
            present=None if batch.present is None else expand(batch.present),
        )
        evidence = self.filter.encode_after(window, len(window) - 1)
        for intervention in self._interventions:
            evidence = self.replay.apply_weights(evidence, intervention)
        belief = repeat_belief(self.replay.beliefs[self.step], count)
        _, trace = self.filter.step(belief, evidence[0], self.replay.generator(self.step, Common))
        return trace, evidence[0]

    def _targets(self) -> Iterable[Target]:
        for i, component in enumerate(self.filter.task.components):
            yield Target(component.name, *component.conversion, self._component(i), self)
        if isinstance(self.filter, SequenceModel):
            return
        for k, name in enumerate(self.filter.names):
            yield Target(f"log-likelihood:{name}", "nats", 1.0, self._log_likelihood(k), self)
        if self.replay.evidence.log_weights is not None:
            for k, name in enumerate(self.filter.names):
                yield Target(f"beta:{name}", "", 1.0, self._beta(k), self)

    def _component(self, i: int) -> Value:
        """Component of the fused estimate, m or rad; for a particle filter the weighted mean before resampling."""
        return lambda trace, evidence: self.filter.statistics.state_to_si(trace.estimate.mean)[:, i]

    def _beta(self, k: int) -> Value:
        """Network output beta, averaged over components."""

        def value(trace: StepTrace, evidence: Evidence) -> Tensor:
            assert evidence.log_weights is not None
            return evidence.log_weights[:, k].exp().mean(-1)

        return value

    def _log_likelihood(self, k: int) -> Value:
        """``ln p_k(z | x) - ln p_k(z)``, nats: the observation's contribution to the log density at ``place``.

        The evidence p_k(z) under the predicted belief cancels the unknown constant of a particle filter's likelihood.
        For a Kalman filter the value is ln posterior - ln predicted, by Bayes' rule.
        """

        def particles(trace: StepTrace, evidence: Evidence) -> Tensor:
            assert isinstance(self.filter, ParticleFilter)
            assert isinstance(trace.predicted, Particles)
            assert trace.log_likelihood is not None
            place = self.place.expand(len(trace.log_likelihood), 1, -1)
            likelihood = self.filter.log_likelihood(evidence, place)[:, k, 0]
            return likelihood - torch.logsumexp(trace.predicted.log_weights + trace.log_likelihood[:, k], dim=-1)

        def kalman(trace: StepTrace, evidence: Evidence) -> Tensor:
            assert isinstance(trace.predicted, Gaussian)
            assert trace.modality is not None
            posterior, predicted = (
                MultivariateNormal(belief.mean[:, k].double(), belief.covariance[:, k].double()).log_prob(self.place)
                for belief in (trace.modality, trace.predicted)
            )
            return posterior - predicted

        return particles if isinstance(self.filter, ParticleFilter) else kalman

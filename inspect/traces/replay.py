"""Replay of a traced run from any step, unchanged or with interventions: sensor faults or manual fusion weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Belief, Evidence, StepTrace
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress, one_thread
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import WEIGHTED
from beliefscope.filters.rollout import first_belief
from beliefscope.filters.subsets import standalone_evidence
from beliefscope.inspect.traces.data import ARRAYS, Trace, check_origin, check_step, provenance_of
from beliefscope.inspect.traces.run import assemble_trace, step_arrays, with_fewer_particles


@dataclass(frozen=True)
class Intervention:
    """An intervention over steps ``first`` to ``to - 1``.

    Attributes:
        first: first step.
        to: first step after the intervention.
        faults: sensor faults to inject in addition to those of the run. They use the intervention's steps; a fault
            with its own steps is rejected.
        weights: modality -> beta, 0 to 1, replacing the network output in all components. Other modalities share the
            remainder in the network's proportions; if all modalities are given, the values sum to one.

    Raises BadInput for an empty span, a fault with its own steps, and invalid weights.
    """

    first: int
    to: int
    faults: Faults = NO_FAULTS
    weights: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if not 0 <= self.first < self.to:
            span = f"from step {self.first} to {self.to}"
            raise BadInput(f"an intervention {span} has no steps: 'to' is the first step after it")
        for fault in self.faults:
            if fault.from_ != 0 or fault.to is not None:
                raise BadInput(f"{fault} has its own steps; faults of an intervention use its steps")
        total = sum(self.weights.values())
        if not all(0.0 <= beta <= 1.0 for beta in self.weights.values()) or total > 1.0 + 1e-6:
            text = ", ".join(f"{name}={beta:g}" for name, beta in self.weights.items())
            raise BadInput(f"weights {text}: each weight and their sum must be between 0 and 1")

    @classmethod
    def parse(cls, text: str) -> Intervention:
        """Parse URL syntax: ``from=20&to=40&faults=blackout&weights=image=0.9``.

        Raises BadInput for invalid text, and if it has neither faults nor weights.
        """
        values = dict(parse_qsl(text, keep_blank_values=True))
        keys = ("from", "to", "faults", "weights")
        for key in values:
            check_name("part of an intervention", key, keys)
        intervention = cls(
            _step(text, values, "from"),
            _step(text, values, "to"),
            Faults.parse(values.get("faults", "")),
            parse_weights(values.get("weights", "")),
        )
        if not intervention.faults and not intervention.weights:
            raise BadInput(f"intervention {text!r} is empty: give faults, weights or both")
        return intervention

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Intervention:
        """Inverse of ``to_json``; earlier versions wrote ``faults`` as ``recipe``."""
        faults = value["faults"] if "faults" in value else value["recipe"]
        return cls(value["from"], value["to"], Faults.from_json(faults), value["weights"])

    @property
    def timed_faults(self) -> Faults:
        """The faults, restricted to the steps of the intervention."""
        return Faults(tuple(replace(fault, from_=self.first, to=self.to) for fault in self.faults))

    def check(self, checkpoint: Checkpoint, steps: int) -> None:
        """Raise BadInput if the intervention does not fit a filter and an episode of that many steps."""
        check_step(self.first, steps, "episode")
        if self.to > steps:
            raise BadInput(f"step {self.to} is after the last step of this episode, {steps - 1}")
        self.timed_faults.check(checkpoint.task)
        self.check_weights(checkpoint)

    def check_weights(self, checkpoint: Checkpoint) -> None:
        """Raise BadInput for weights that the filter does not have."""
        if not self.weights:
            return
        if isinstance(checkpoint, ExternalFilter):
            name = checkpoint.name
            raise BadInput(f"filter {name} is external: its fusion weights cannot be set; use sensor faults")
        names = checkpoint.filter.names
        for name in self.weights:
            check_name(f"modality of filter {checkpoint.name!r}", name, names)
        if checkpoint.filter.architecture.fusion not in WEIGHTED:
            raise BadInput(f"filter {checkpoint.name!r} has no fusion weights beta; only crossmodal filters have")
        total = sum(self.weights.values())
        if len(self.weights) == len(names) and total < 1.0 - 1e-6:
            raise BadInput(f"weights of all modalities sum to {total:g}; they must sum to 1")

    def provenance_after(self, original: Trace) -> dict[str, Any]:
        """``provenance_of`` a run with a further intervention, this one."""
        edits = [*original.settings.get("edits", []), self.to_json()]
        faults = original.faults + self.timed_faults
        return provenance_of(original) | {"faults": faults, "settings": {**original.settings, "edits": edits}}

    def mask(self, steps: int) -> NDArray[np.bool_]:
        """(T,) mask of the steps of the intervention."""
        index = np.arange(steps)
        return (index >= self.first) & (index < self.to)

    def __str__(self) -> str:
        parts = [str(self.faults)] if self.faults else []
        parts += [f"beta of {name} {beta:g}" for name, beta in self.weights.items()]
        return f"{', '.join(parts) or 'nothing'} over steps {self.first} to {self.to - 1}"

    def to_json(self) -> dict[str, Any]:
        """``from``, ``to``, ``faults`` and ``weights`` as JSON values."""
        return {
            "from": self.first,
            "to": self.to,
            "faults": self.faults.to_json(),
            "weights": dict(self.weights),
        }


def parse_weights(text: str) -> dict[str, float]:
    """Parse ``image=0.9,haptics=0.1`` into modality -> beta. Raises BadInput for invalid text."""
    weights: dict[str, float] = {}
    for part in text.split(",") if text.strip() else ():
        name, equals, value = part.strip().partition("=")
        try:
            beta = float(value)
        except ValueError:
            equals = ""
        if not equals or not name or name in weights:
            raise BadInput(
                f"weights {text!r}: {part.strip()!r} is not MODALITY=BETA such as image=0.9, each modality once"
            )
        weights[name] = beta
    return weights


def _step(text: str, values: Mapping[str, str], key: str) -> int:
    value = values.get(key, "")
    if not (value.isascii() and value.isdigit() and len(value) < 10):
        raise BadInput(f"{key!r} of intervention {text!r} must be a step, an integer from 0, not {value!r}")
    return int(value)


class Replay:
    """A repeated run of a trace that stores the belief and the generator state before every step.

    Attributes:
        original: trace of the repeated run.
        exact: whether ``original`` is bit-identical to the given trace, which holds on the same platform and versions.
        evidence: evidence of the trace's episode.
        beliefs: T beliefs, one before each step.
        generator_states: T generator states, one before each step.
    """

    @one_thread()  # as the traced run
    @torch.no_grad()
    def __init__(self, checkpoint: Checkpoint, trace: Trace, progress: Progress = None) -> None:
        """Raises BadInput if the trace is from another checkpoint. progress: called with the completed fraction."""
        check_origin(checkpoint, trace)
        filter_ = checkpoint.filter
        self.checkpoint = checkpoint
        self.batch = Steps.from_episodes(filter_.task, [trace.episode]).episode(0)
        self.evidence = filter_.encode(self.batch)
        self._standalone = trace.settings.get("standalone", "")
        for intervention in trace.settings.get("edits", []):
            self.evidence = self.apply_weights(self.evidence, Intervention.from_json(intervention))
        if self._standalone:
            self.evidence = standalone_evidence(filter_, self.batch, self.evidence, self._standalone)
        self.start = first_belief(filter_, self.batch)
        generator = torch.Generator().manual_seed(trace.seed)
        belief = filter_.start(self.start, int(trace.settings["particles"]), generator)
        self.beliefs: list[Belief] = []
        self.generator_states: list[Tensor] = []
        self.steps: list[StepTrace] = []
        for t in range(len(trace)):
            self.beliefs.append(belief)
            self.generator_states.append(generator.get_state())
            belief, step = filter_.step(belief, self.evidence[t], generator)
            self.steps.append(step)
            if progress is not None:
                progress((t + 1) / len(trace))
        self._kept = 0 if trace.particles is None else trace.particles.shape[1]
        self.original = self._trace(trace.episode, self.evidence, self.steps, provenance_of(trace))
        self.exact = have_equal_arrays(trace, self.original)

    def generator(self, step: int, kind: type[torch.Generator] = torch.Generator) -> torch.Generator:
        """A generator in the original run's state before a step."""
        generator = kind()
        generator.set_state(self.generator_states[step])
        return generator

    @one_thread()
    @torch.no_grad()
    def with_intervention(self, intervention: Intervention) -> Trace:
        """Trace from the belief before step ``intervention.first``, with the original's random numbers.

        The number of random draws per step does not depend on the observation, so an intervention without effect
        reproduces the original bit for bit. The faults of the result are the original's followed by the intervention's,
        which are injected into the observations of the original run. ``settings`` lists the interventions as ``edits``.

        Raises BadInput for an unknown sensor or modality, weights for a filter without a weight model, and steps
        outside the trace.
        """
        intervention.check(self.checkpoint, len(self.beliefs))
        filter_, original = self.checkpoint.filter, self.original
        episode = intervention.timed_faults.apply(original.episode, original.seed)
        evidence = self.evidence
        if intervention.faults:
            batch = Steps.from_episodes(filter_.task, [episode]).episode(0)
            evidence = filter_.encode(batch)
            if self._standalone:
                evidence = standalone_evidence(filter_, batch, evidence, self._standalone)
        provenance = intervention.provenance_after(original)
        for values in provenance["settings"]["edits"]:
            evidence = self.apply_weights(evidence, Intervention.from_json(values))
        belief, generator = self.beliefs[intervention.first], self.generator(intervention.first)
        steps = self.steps[: intervention.first]
        for t in range(intervention.first, len(self.beliefs)):
            belief, step = filter_.step(belief, evidence[t], generator)
            steps.append(step)
        return self._trace(episode, evidence, steps, provenance)

    def _trace(
        self, episode: Episode, evidence: Evidence, steps: Sequence[StepTrace], provenance: Mapping[str, Any]
    ) -> Trace:
        arrays = with_fewer_particles(step_arrays(self.checkpoint, evidence, steps), self._kept)
        return assemble_trace(self.checkpoint, episode, self.start, arrays, **provenance)

    def apply_weights(self, evidence: Evidence, intervention: Intervention) -> Evidence:
        """Replace beta in the evidence by the weights of an intervention.

        Raises BadInput for weights that the filter does not have, and for a standalone run, which has none.
        """
        if not intervention.weights:
            return evidence
        intervention.check_weights(self.checkpoint)
        if self._standalone:
            raise BadInput(f"standalone {self._standalone} has no fusion weights: it uses one modality")
        assert evidence.log_weights is not None
        names = self.checkpoint.filter.names
        span = slice(intervention.first, intervention.to)
        beta = evidence.log_weights[span].exp()
        manual = torch.tensor([intervention.weights.get(name, torch.nan) for name in names]).unsqueeze(-1)
        automatic = manual.isnan()
        remainder = max(0.0, 1.0 - sum(intervention.weights.values()))
        others = (beta * automatic).sum(-2, keepdim=True).clamp_min(torch.finfo(beta.dtype).tiny)  # 0 if absent
        log_weights = evidence.log_weights.clone()
        log_weights[span] = torch.where(automatic, remainder * beta / others, manual).log()
        return evidence.with_log_weights(log_weights)


def repeat_belief(belief: Belief, count: int) -> Belief:
    """Expand a belief with N = 1 to ``count`` trajectories."""
    tensors = (getattr(belief, f.name) for f in fields(belief))
    return type(belief)(*(tensor.expand(count, *tensor.shape[1:]) for tensor in tensors))


def have_equal_arrays(first: Trace, second: Trace) -> bool:
    """Whether two traces have the same arrays with the same values, NaN included."""
    pairs = [(getattr(first, name), getattr(second, name)) for name in ARRAYS]
    return all(a is b if a is None or b is None else np.array_equal(a, b, equal_nan=True) for a, b in pairs)

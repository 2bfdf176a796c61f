"""Running a filter again from any step of a trace: as it was, or with a sensor or the fusion weights edited."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.faults.injection import WHOLE, Faults
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Belief, Evidence, StepTrace
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.rollout import start_at_truth
from beliefscope.inspect.trace import ARRAYS, Trace, assemble


@dataclass(frozen=True)
class Edit:
    """What is changed from step ``first`` up to, but without, step ``to``.

    Attributes:
        faults: how sensors are broken meanwhile, on top of how they already were. The span is the edit's: a fault with
            one of its own is refused.
        weights: modality -> beta, 0 to 1, in place of the network's, in all components. Modalities that are not named
            share what is left in the proportions that the network gave them; where all are named, they sum to one.

    Raises BadInput for an empty span, a fault with its own, and weights that no beta can have.
    """

    first: int
    to: int
    faults: Faults = WHOLE
    weights: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if not 0 <= self.first < self.to:
            raise BadInput(f"an edit from step {self.first} to {self.to} has no steps: 'to' is the first step after it")
        for fault in self.faults:
            if fault.from_ != 0 or fault.to is not None:
                raise BadInput(f"{fault} has a span of its own; that of an edit is for all its faults")
        total = sum(self.weights.values())
        if not all(0.0 <= beta <= 1.0 for beta in self.weights.values()) or total > 1.0 + 1e-6:
            given = ", ".join(f"{name}={beta:g}" for name, beta in self.weights.items())
            raise BadInput(f"weights {given}: each is from 0 to 1, and so is their sum")

    @classmethod
    def parse(cls, text: str) -> Edit:
        """From its text, ``from=20&to=40&faults=blackout&weights=image=0.9``, as in an address.

        Raises BadInput for anything else, and where neither a faults nor weights are given.
        """
        given = dict(parse_qsl(text, keep_blank_values=True))
        known = ("from", "to", "faults", "weights")
        for key in given:
            if key not in known:
                raise one_of("part of an edit", key, known)
        edit = cls(
            _step(text, given, "from"),
            _step(text, given, "to"),
            Faults.parse(given.get("faults", "")),
            betas(given.get("weights", "")),
        )
        if not edit.faults and not edit.weights:
            raise BadInput(f"nothing is edited by {text!r}: give a faults, weights or both")
        return edit

    @classmethod
    def of(cls, value: Mapping[str, Any]) -> Edit:
        """From ``to_json``'s values."""
        return cls(value["from"], value["to"], Faults.of(value["faults"]), value["weights"])

    @property
    def timed_faults(self) -> Faults:
        """The faults, limited to the edited steps."""
        return Faults(tuple(replace(fault, from_=self.first, to=self.to) for fault in self.faults))

    def mask(self, steps: int) -> NDArray[np.bool_]:
        """(T,) bool: the edited steps."""
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


def betas(text: str) -> dict[str, float]:
    """``image=0.9,haptics=0.1`` as numbers by modality. Raises BadInput for anything else."""
    given: dict[str, float] = {}
    for part in text.split(",") if text.strip() else ():
        name, equals, value = part.strip().partition("=")
        try:
            beta = float(value)
        except ValueError:
            equals = ""
        if not equals or not name or name in given:
            raise BadInput(f"weights {text!r}: {part.strip()!r} is not a new MODALITY=BETA such as image=0.9")
        given[name] = beta
    return given


def _step(text: str, given: Mapping[str, str], key: str) -> int:
    value = given.get(key, "")
    if not (value.isascii() and value.isdigit() and len(value) < 10):
        raise BadInput(f"{key!r} of the edit {text!r} is a step, an integer from 0; got {value!r}")
    return int(value)


class Replay:
    """The run behind a trace, taken again, with the belief and the generator's state before every step.

    Attributes:
        original: the trace of this run. exact: whether it equals the given trace in every bit, as it does on the
            machine and with the versions that made it.
        evidence: of the trace's episode. beliefs: T of them, before each step. random: T states of the generator.
    """

    @torch.no_grad()
    def __init__(self, checkpoint: Checkpoint, trace: Trace, progress: Callable[[float], None] | None = None) -> None:
        """Raises BadInput when the trace was made by another checkpoint. progress: called with the share done."""
        if trace.checkpoint_hash != checkpoint.hash:
            raise BadInput(
                f"the trace was made by checkpoint {trace.checkpoint_hash[:12]}, not by {checkpoint.hash[:12]}"
            )
        filter_ = checkpoint.filter
        self.checkpoint = checkpoint
        self.batch = Steps.of(filter_.task, [trace.episode]).episode(0)
        self.evidence = filter_.encode(self.batch)
        for edit in trace.settings.get("edits", []):
            self.evidence = self.weighed(self.evidence, Edit.of(edit))
        self.start = start_at_truth(filter_, self.batch)
        generator = torch.Generator().manual_seed(trace.seed)
        belief = filter_.start(self.start, int(trace.settings["particles"]), generator)
        self.beliefs: list[Belief] = []
        self.random: list[Tensor] = []
        self.steps: list[StepTrace] = []
        for t in range(len(trace)):
            self.beliefs.append(belief)
            self.random.append(generator.get_state())
            belief, step = filter_.step(belief, self.evidence[t], generator)
            self.steps.append(step)
            if progress is not None:
                progress((t + 1) / len(trace))
        same = ("data_hash", "episode_index", "seed", "faults", "settings")
        self._given = {name: getattr(trace, name) for name in same}
        self.original = assemble(checkpoint, trace.episode, self.start, self.evidence, self.steps, **self._given)
        self.exact = all(_equal(getattr(trace, name), getattr(self.original, name)) for name in ARRAYS)

    def check_step(self, step: int) -> None:
        """Raises BadInput for a step that the trace has not."""
        if not 0 <= step < len(self.beliefs):
            raise BadInput(f"step {step} is not in this trace: it has steps 0 to {len(self.beliefs) - 1}")

    def generator(self, step: int, kind: type[torch.Generator] = torch.Generator) -> torch.Generator:
        """A generator that is where the original's was before the step."""
        generator = kind()
        generator.set_state(self.random[step])
        return generator

    @torch.no_grad()
    def edited(self, edit: Edit) -> Trace:
        """The trace of the edited run: from the belief before step ``edit.first``, with the original's random numbers.

        A filter draws as many numbers at a step whatever it observes, so every step draws what it drew before, and an
        edit that changes nothing gives the original in every bit. The trace's faults is the original's followed by the
        edit's, whose draws depend on the episode as the original saw it; its settings keep the ``edits``.

        Raises BadInput where a sensor or modality does not exist, weights are given to a filter without a weight model,
        or the span leaves the trace.
        """
        self.check_step(edit.first)
        if edit.to > len(self.beliefs):
            raise BadInput(f"step {edit.to} is beyond this trace, which ends after step {len(self.beliefs) - 1}")
        filter_, original = self.checkpoint.filter, self.original
        episode = edit.timed_faults.apply(original.episode, original.seed)
        evidence = self.evidence
        if edit.faults:
            evidence = filter_.encode(Steps.of(filter_.task, [episode]).episode(0))
        edits = [*original.settings.get("edits", []), edit.to_json()]
        for one in edits:
            evidence = self.weighed(evidence, Edit.of(one))
        belief, generator = self.beliefs[edit.first], self.generator(edit.first)
        steps = self.steps[: edit.first]
        for t in range(edit.first, len(self.beliefs)):
            belief, step = filter_.step(belief, evidence[t], generator)
            steps.append(step)
        changed = self._given | {
            "faults": original.faults + edit.timed_faults,
            "settings": {**original.settings, "edits": edits},
        }
        return assemble(self.checkpoint, episode, self.start, evidence, steps, **changed)

    def weighed(self, evidence: Evidence, edit: Edit) -> Evidence:
        """The evidence with beta as the edit has it."""
        if not edit.weights:
            return evidence
        names = self.checkpoint.filter.names
        for name in edit.weights:
            if name not in names:
                raise one_of(f"modality of filter {self.checkpoint.name!r}", name, names)
        if evidence.log_weights is None:
            raise BadInput(f"filter {self.checkpoint.name!r} weighs nothing by beta: only crossmodal ones do")
        span = slice(edit.first, edit.to)
        beta = evidence.log_weights[span].exp()
        by_hand = torch.tensor([edit.weights.get(name, torch.nan) for name in names]).unsqueeze(-1)
        free = by_hand.isnan()
        left = max(0.0, 1.0 - sum(edit.weights.values()))
        others = (beta * free).sum(-2, keepdim=True)
        if not free.any() and left > 1e-6:
            raise BadInput(f"weights of all modalities sum to {1.0 - left:g}, not to 1")
        log_weights = evidence.log_weights.clone()
        log_weights[span] = torch.where(free, left * beta / others, by_hand).log()
        return replace(evidence, log_weights=log_weights)


def repeated(belief: Belief, count: int) -> Belief:
    """A belief with N = 1 as that of ``count`` trajectories."""
    tensors = (getattr(belief, one.name) for one in fields(belief))
    return type(belief)(*(tensor.expand(count, *tensor.shape[1:]) for tensor in tensors))


def _equal(one: NDArray[Any] | None, other: NDArray[Any] | None) -> bool:
    if one is None or other is None:
        return one is other
    return np.array_equal(one, other, equal_nan=True)

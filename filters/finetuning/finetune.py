"""Fine-tuning: a child of a trained filter, in which some parts go on learning and all others stay as they are."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch

from beliefscope.datasets.dataset import SPLITS
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.batch_mix import Mix, Moment
from beliefscope.filters.finetuning.loop import Look, Tuning, look
from beliefscope.filters.finetuning.module_selection import chosen, digest, freeze
from beliefscope.filters.finetuning.slices import NOMINAL, Slice
from beliefscope.filters.training.encoder_cache import numbered, recalling
from beliefscope.filters.training.resume import Partial, key_of
from beliefscope.filters.training.train import versions

MOST = {"length": 10**4, "windows": 1024, "steps": 10**7, "check": 10**7, "patience": 10**7, "particles": 10**4}
"""Of what counts the memory that a step takes, and the time of a run."""


@dataclass(frozen=True)
class FineTune:
    """What is trained, on what, and how. What is left out makes a sensible run of about a minute.

    Attributes:
        train, freeze: presets and patterns of trained and frozen modules (``module_selection.py``).
        mix: slices to learn, and how much each counts beside the others. nominal: share of the loss that nominal data
            have, to hold the rest in place; 1 where there are no slices.
        moments: of chosen episodes, all that is learned of the slices; without any, of all training episodes.
        length: steps of a window. windows: in a step. steps: of the optimiser, at most.
        rate: Adam's learning rate, which falls to a twentieth. rates: patterns with rates of their own, the last that
            matches counts; without, ``dynamics.log_noise`` has ten times the rate, picture encoders a third.
        pull: strength of the decay towards the parent's weights. check: steps between two looks at the validation
            episodes. patience: looks without a better one that end the run.
        particles, likelihood_weight: as in training (``train.Plan``). seed: of all draws.
    """

    train: tuple[str, ...] = ()
    freeze: tuple[str, ...] = ()
    mix: tuple[tuple[Slice, float], ...] = ()
    nominal: float = 0.5
    moments: tuple[Moment, ...] = ()
    length: int = 32
    windows: int = 16
    steps: int = 300
    rate: float = 3e-4
    rates: tuple[tuple[str, float], ...] = ()
    pull: float = 1.0
    check: int = 25
    patience: int = 6
    particles: int = 30
    likelihood_weight: float = 0.05
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of its range."""
        for name, most in MOST.items():
            value = getattr(self, name)
            if not 1 <= value <= most:
                raise BadInput(f"{name} of a fine-tuning is {value}, not a whole number from 1 to {most}")
        if not 0 <= self.seed < 2**63:
            raise BadInput(f"seed of a fine-tuning is {self.seed}, not a whole number from 0 to 2^63 - 1")
        for name in ("rate", "pull", "likelihood_weight"):
            value = getattr(self, name)
            if not (0.0 < value < math.inf or (value == 0.0 and name != "rate")):
                raise BadInput(f"{name} of a fine-tuning is {value!r}, not a number of at least 0")
        if not 0.0 <= self.nominal <= 1.0:
            raise BadInput(f"the nominal share is {self.nominal!r}, not from 0 to 1")
        for pattern, rate in self.rates:
            if not 0.0 <= rate < math.inf:
                raise BadInput(f"the rate of {pattern!r} is {rate!r}, not a number of at least 0")
        for one, share in self.mix:
            if not 0.0 < share < math.inf:
                raise BadInput(f"the share of slice {one.name!r} is {share!r}, not above 0")
        if len({one.name for one, _ in self.mix} | {NOMINAL.name}) != len(self.mix) + 1:
            raise BadInput(
                f"two slices have one name, or one is called {NOMINAL.name!r}, which always means all as it is"
            )

    def shares(self) -> dict[Slice, float]:
        """Of every slice in the loss, nominal first; they sum to 1."""
        total = sum(share for _, share in self.mix)
        nominal = self.nominal if self.mix else 1.0
        others = {one: (1.0 - nominal) * share / total for one, share in self.mix}
        return {one: share for one, share in {NOMINAL: nominal, **others}.items() if share > 0.0}

    def to_json(self) -> dict[str, Any]:
        """``FineTune.of`` makes the same of it."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        return plain | {
            "train": list(self.train),
            "freeze": list(self.freeze),
            "mix": [{"slice": one.to_json(), "share": share} for one, share in self.mix],
            "moments": [str(one) for one in self.moments],
            "rates": [list(one) for one in self.rates],
        }

    @classmethod
    def of(cls, value: Any) -> FineTune:
        """From ``to_json``'s values, any of which may be left out. Raises BadInput for anything else."""
        if not isinstance(value, Mapping):
            raise BadInput(f'settings of a fine-tuning are {value!r}, not an object such as {{"steps": 300}}')
        known = {f.name: f for f in fields(cls)}
        given: dict[str, Any] = {}
        for key, one in value.items():
            if key not in known:
                raise one_of("setting of a fine-tuning", str(key), known)
            try:
                given[key] = _READ[known[key].type](one)
            except (TypeError, ValueError, KeyError, AttributeError, OverflowError) as error:
                if isinstance(error, BadInput):
                    raise
                raise BadInput(f"setting {key!r} of a fine-tuning is {one!r}, which does not fit") from None
        return cls(**given)


def _names(value: Any) -> tuple[str, ...]:
    if isinstance(value, str) or not all(isinstance(one, str) for one in value):
        raise TypeError
    return tuple(value)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return float(value)


def _whole(value: Any) -> int:
    if _number(value) != int(value):
        raise TypeError
    return int(value)


_READ: dict[Any, Callable[[Any], Any]] = {
    "tuple[str, ...]": _names,
    "tuple[tuple[Slice, float], ...]": lambda v: tuple((Slice.of(one["slice"]), _number(one["share"])) for one in v),
    "tuple[Moment, ...]": lambda v: tuple(Moment.parse(one) for one in v),
    "tuple[tuple[str, float], ...]": lambda v: tuple((str(name), _number(rate)) for name, rate in v),
    "float": _number,
    "int": _whole,
}
"""Type of a setting, as written -> from JSON."""


@dataclass(frozen=True)
class FineTuned:
    """filter: in evaluation mode, on the CPU. record: JSON for the checkpoint, ``parent`` and proof included."""

    filter: Filter
    record: dict[str, Any]


def finetune(
    parent: Checkpoint,
    episodes: Sequence[Episode],
    *,
    data_hash: str,
    settings: FineTune | None = None,
    command: str = "",
    report: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    looked: Callable[[Look], None] = lambda found: None,
    resumed: Callable[[int], None] = lambda step: None,
    stop: Callable[[], bool] = lambda: False,
    partial: Path | None = None,
    device: str | None = None,
) -> FineTuned | None:
    """A child of ``parent``, which itself stays as it is; None where ``stop`` said to pause.

    The weights that do best on ``val`` episodes are kept, the parent's among them: a child is never worse there, by its
    own measure (``tuning.score``). Every eighth training episode stands in where the data have no ``val``. Frozen
    encoders are asked once for each picture. The same seed on the same machine gives the same weights, killed or paused
    and resumed or not.

    Args:
        episodes: all of the data set; their places are the indices in ``settings.moments``. What is chosen there is
            learned from, whatever its split, and not measured on.
        report: called after each step with the loss. looked: with each look at the validation episodes, the parent's
            first; again from the start of a run that is resumed. resumed: with the step at which a run goes on.
        stop: asked before each step. partial: file from which a run goes on that was paused or killed.

    Raises:
        BadInput: a pattern that matches nothing, a slice or moment that does not fit, no training episode.
    """
    settings = settings or FineTune()
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    began, spent = time.monotonic(), 0.0
    filter_ = copy.deepcopy(parent.filter).to(device)
    trained = chosen(filter_, settings.train, settings.freeze)
    frozen = freeze(filter_, trained)
    proof = digest(filter_, frozen)
    groups, moments = _split(episodes, settings.moments)
    counts = {name: len(members) for name, members in groups.items()}
    mixes = {
        name: Mix.of(filter_.task, filter_.names, settings.shares(), members, settings.seed, moments.get(name), device)
        for name, members in groups.items()
    }
    steps, pictures = numbered([mix.steps for mix in mixes.values()])
    for name, numbers in zip(list(mixes), steps, strict=True):
        mixes[name] = mixes[name].on(numbers)
    key = key_of(parent=parent.hash, settings=settings.to_json(), data=data_hash, versions=versions(), device=device)
    kept = Partial(partial, key) if partial else None
    with recalling(filter_, pictures):
        before = look(filter_, mixes["test"], 0, 0.0, settings)
        tuning = Tuning(filter_, trained, settings, mixes["train"], mixes["val"])
        if kept is not None and (found := kept.load()) is not None:
            spent = tuning.restore(*found)
            resumed(tuning.done)
        else:
            tuning.begin()
        for one in tuning.looks:
            looked(one)
        while not tuning.finished:
            paused = stop()
            if not paused:
                report(tuning.done + 1, settings.steps, tuning.step())
                if tuning.due:
                    looked(tuning.look())
            if kept is not None and (paused or tuning.due):
                kept.save(*tuning.state(spent + time.monotonic() - began))
            if paused:
                return None
        tuning.take_best()
        after = look(filter_, mixes["test"], tuning.best_step, 0.0, settings)
    assert digest(filter_, frozen) == proof, "what is frozen moved"
    filter_.eval().requires_grad_(False)
    record = {
        "command": command,
        "seed": settings.seed,
        "parent": {"hash": parent.hash, "name": parent.name, "settings": settings.to_json()},
        "data_hash": data_hash,
        "episodes": counts,
        "steps": tuning.done,
        "best_step": tuning.best_step,
        "looks": [asdict(one) for one in tuning.looks],
        "held_out": {"before": before.slices, "after": after.slices},
        "frozen": {"tensors": len(frozen), "before": proof, "after": digest(filter_, frozen)},
        "parts": tuning.parts(),
        "seconds": round(spent + time.monotonic() - began, 1),
        "versions": versions(),
        "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "metrics": {"0": {"fused": evaluate(filter_, groups["test"]).to_dict()}},
    }
    if kept is not None:
        kept.drop()
    return FineTuned(filter_.cpu(), record)


def _split(
    episodes: Sequence[Episode], chosen: Sequence[Moment]
) -> tuple[dict[str, list[Episode]], dict[str, dict[int, list[Moment]]]]:
    """Episodes to train on, to validate on and to test on; and of the first the place of each that was chosen."""
    of: dict[int, list[Moment]] = {}
    for moment in chosen:
        if moment.episode >= len(episodes):
            raise BadInput(f"Episode {moment.episode} is not in the data, which has episodes 0 to {len(episodes) - 1}.")
        if moment.first >= len(episodes[moment.episode]):
            raise BadInput(f"moment {moment} begins after its episode's {len(episodes[moment.episode])} steps")
        of.setdefault(moment.episode, []).append(moment)
    split = {name: [i for i, e in enumerate(episodes) if e.split == name and i not in of] for name in SPLITS}
    train = sorted([*split["train"], *of])
    if not train:
        raise BadInput("the data set has no episode of split 'train'")
    val = split["val"]
    if not val:
        val = [i for i in train if i not in of][::8] or train
        train = [i for i in train if i not in val or i in of] or train
    places = {"train": train, "val": val, "test": split["test"] or val}
    groups = {name: [episodes[i] for i in found] for name, found in places.items()}
    return groups, {"train": {train.index(i): moments for i, moments in of.items()}}

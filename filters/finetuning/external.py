"""Fine-tuning of an external filter: its torch module, trained on a loss that its file defines."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, type_name
from beliefscope.datasets.io import user_code
from beliefscope.datasets.text import plural
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.external.calls import inputs_of, seeded
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.finetuning.finetune import Callbacks, run_loop, split_episodes
from beliefscope.filters.finetuning.loop import FineTuneLoop, Validation
from beliefscope.filters.finetuning.module_selection import digest, freeze, select_parameters
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.start_offset import without_start_offset
from beliefscope.filters.training.resume import Partial, cache_key
from beliefscope.filters.training.train import versions


@dataclass(frozen=True)
class Windows:
    """N windows of T steps, the second argument of an external filter's loss; SI units, angles in rad.

    Attributes:
        observations: key -> (T, N, ...), images uint8, as the filter receives them. controls: (T, N, c).
        states: (T, N, n) true states. mean, covariance: (N, n), (N, n, n) first belief, at the first true state.
    """

    observations: Mapping[str, Tensor]
    controls: Tensor
    states: Tensor
    mean: Tensor
    covariance: Tensor


Loss = Callable[[nn.Module, Windows], Tensor]
"""``loss(module, windows)``: a scalar with gradients; the module is that of the adapter."""


def loss_of(source: str) -> Loss:
    """The function ``loss`` in the file or package of a build function. Raises BadInput if there is none."""
    place = source.rpartition(":")[0]
    with user_code.importable(place):
        function = getattr(user_code.load_module(place), "loss", None)
    if not callable(function):
        raise BadInput(f"{place} has no function loss(module, windows), which fine-tuning of an external filter needs")
    return function


def has_loss(source: str) -> bool:
    """Whether a build function has a loss, so that its filter can be fine-tuned."""
    try:
        loss_of(source)
    except BadInput:
        return False
    return True


def finetune_external(
    base: ExternalFilter,
    loss: Loss,
    episodes: Sequence[Episode],
    *,
    data_hash: str,
    settings: FineTune,
    command: str,
    callbacks: Callbacks,
    partial: Path | None = None,
) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Fine-tunes a copy of the filter's module on its own loss, as ``finetune`` does; None if paused.

    The weights with the lowest main error on ``val`` episodes are kept, those of ``base`` included.

    Returns the tensors of the module and the record.

    Raises BadInput for a filter without a torch module, unknown modules, slices other than of faults, no training
    episode, and a loss that fails or is not a finite scalar with gradients.
    """
    if not isinstance(base.adapter.module, nn.Module):
        raise BadInput(f"{base.source} is {type_name(base.adapter.module)}, fine-tuning needs a torch module")
    for slice_, _ in settings.mix:
        if slice_.contact is not None or slice_.only:
            raise BadInput(f"slice {slice_.name!r}: external filters are fine-tuned on slices of sensor faults only")
    if settings.events or settings.calibrate or settings.success:
        raise BadInput("--event, --calibrate and --success do not apply to external filters")
    began = time.monotonic()
    module = copy.deepcopy(base.adapter.module)
    tuned = ExternalFilter(replace(base.adapter, module=module), base.task, base.name, base.source)
    trained = select_parameters(module, settings.train, settings.freeze)
    frozen = freeze(module, trained)
    frozen_digest = digest(module, frozen)
    groups, _ = split_episodes(episodes, ())
    key = cache_key(base=base.hash, settings=settings.to_json(), data=data_hash, versions=versions())
    state = Partial(partial, key) if partial else None
    loop = ExternalLoop(tuned, loss, trained, settings, groups)
    before = loop.measure(0, None, "test")
    seconds = run_loop(loop, state, began, callbacks)
    if seconds is None:
        return None
    callbacks.on_evaluation()
    loop.restore_best()
    after = loop.measure(loop.best_step, None, "test")
    assert digest(module, frozen) == frozen_digest, "a frozen parameter changed"
    record = {
        "command": command,
        "seed": settings.seed,
        "base": {"hash": base.hash, "name": base.name, "settings": settings.to_json()},
        "data_hash": data_hash,
        "episodes": {name: len(members) for name, members in groups.items()},
        "steps": loop.done,
        "best_step": loop.best_step,
        "validations": [asdict(validation) for validation in loop.validations],
        "held_out": {"before": before.slices, "after": after.slices},
        "frozen": {"tensors": len(frozen), "before": frozen_digest, "after": digest(module, frozen)},
        "parts": loop.parameter_changes(),
        "seconds": round(seconds, 1),
        "versions": versions(),
    }
    return {name: tensor.detach().clone() for name, tensor in module.state_dict().items()}, record


class ExternalLoop(FineTuneLoop):
    """The optimisation of an external filter's module on random windows of the training episodes."""

    def __init__(
        self,
        tuned: ExternalFilter,
        loss: Loss,
        trained: Mapping[str, nn.Parameter],
        settings: FineTune,
        groups: Mapping[str, Sequence[Episode]],
    ) -> None:
        """Raises BadInput if no training episode has a window of this length."""
        super().__init__(tuned.adapter.module, trained, settings)
        self._tuned, self._loss, self._groups = tuned, loss, groups
        self._slices = list(settings.shares().items())
        self._train = [slice_.apply_faults(groups["train"], settings.seed) for slice_, _ in self._slices]
        long = [i for i, episode in enumerate(groups["train"]) if len(episode) >= settings.length]
        if not long:
            raise BadInput(f"no training episode has {plural(settings.length, 'step')}; use a smaller --length")
        self._long = np.array(long)

    def step_loss(self, step: int) -> Tensor:
        rng = np.random.default_rng([self.settings.seed, step])
        chosen = rng.choice(len(self._slices), self.settings.windows, p=[share for _, share in self._slices])
        windows = [self._window(self._train[s][rng.choice(self._long)], rng) for s in chosen]
        module, source = self._tuned.adapter.module, self._tuned.source
        freeze(module, self.trained)  # a validation has ended the training mode
        with seeded(int(rng.integers(2**31)), module):
            try:
                value = self._loss(module, self._batch(windows))
            except Exception as error:
                raise BadInput(f"loss of {source} fails: {type(error).__name__}: {error}") from error
        if not isinstance(value, Tensor) or value.shape != () or not value.requires_grad or not value.isfinite():
            raise BadInput(f"loss of {source} is {value!r:.200}, expected a finite scalar with gradients")
        return value

    def measure(self, step: int, loss: float | None, split: str = "val") -> Validation:
        main = self._tuned.task.main_error.key
        slices = {}
        for slice_, _ in self._slices:
            values = evaluate(self._tuned, self._groups[split], faults=slice_.faults, seed=self.settings.seed).to_dict()
            slices[slice_.name] = values | {"error": values["rmse"][main]}
        return Validation(step, loss, slices)

    def _window(self, episode: Episode, rng: np.random.Generator) -> Episode:
        first = int(rng.integers(len(episode) - self.settings.length + 1))
        at = slice(first, first + self.settings.length)
        part = replace(
            episode,
            states=episode.states[at],
            controls=episode.controls[at],
            contact=episode.contact[at],
            qpos=episode.qpos[at],
            observations={key: readings[at] for key, readings in episode.observations.items()},
            covariates={name: values[at] for name, values in episode.covariates.items()},
            time=None if episode.time is None else episode.time[at],
        )
        return without_start_offset(part) if first else part

    def _batch(self, windows: Sequence[Episode]) -> Windows:
        dtype = next(iter(self.trained.values())).dtype
        observations, controls = inputs_of(self._tuned.task, windows, dtype)
        states = torch.from_numpy(np.stack([window.states for window in windows], axis=1)).to(dtype)
        with torch.no_grad():
            start = self._tuned.start(windows)
        return Windows(observations, controls, states, start.mean.to(dtype), start.covariance.to(dtype))

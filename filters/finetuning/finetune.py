"""Fine-tuning: training some modules of a checkpoint further while all others stay frozen."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from beliefscope.datasets.dataset import SPLITS, no_training_episodes
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.text import plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.batch_mix import Mix
from beliefscope.filters.finetuning.loop import FilterLoop, FineTuneLoop, Validation, validate
from beliefscope.filters.finetuning.module_selection import digest, freeze, select_parameters
from beliefscope.filters.finetuning.noise_scale import calibrate_noise, noise_parameters
from beliefscope.filters.finetuning.settings import FineTune, StepRange
from beliefscope.filters.training.encoder_cache import Images, cached_encoders, index_images
from beliefscope.filters.training.resume import Partial, cache_key
from beliefscope.filters.training.train import versions


@dataclass(frozen=True)
class FineTuned:
    """filter: in evaluation mode, on the CPU. record: JSON for the checkpoint, with ``base`` and proof of freezing."""

    filter: Filter
    record: dict[str, Any]


@dataclass(frozen=True)
class Callbacks:
    """Functions that a fine-tuning run calls.

    Attributes:
        report: after each step, with step, total steps and loss. on_validation: after each validation, the base
            checkpoint's first; again with the earlier ones when a run resumes. on_resume: with the step at which a run
            resumes. stop: before each step; the run pauses if it returns true. on_start: before the images are encoded
            and the base checkpoint is evaluated; all arguments are valid by then. on_evaluation: after training, before
            the best weights are evaluated on the test episodes.
    """

    report: Callable[[int, int, float], None] = lambda step, steps, loss: None
    on_validation: Callable[[Validation], None] = lambda validation: None
    on_resume: Callable[[int], None] = lambda step: None
    stop: Callable[[], bool] = lambda: False
    on_start: Callable[[], None] = lambda: None
    on_evaluation: Callable[[], None] = lambda: None


NO_CALLBACKS = Callbacks()


def finetune(
    base: Checkpoint,
    episodes: Sequence[Episode],
    *,
    data_hash: str,
    settings: FineTune | None = None,
    command: str = "",
    callbacks: Callbacks = NO_CALLBACKS,
    partial: Path | None = None,
    device: str | None = None,
) -> FineTuned | None:
    """Fine-tunes a copy of ``base``; returns None if ``callbacks.stop`` paused the run.

    The weights that do best on ``val`` episodes are kept, those of ``base`` included: the result is never worse there,
    as measured by ``loop.score``. Without ``val`` episodes, every eighth training episode takes their place. Frozen
    encoders encode each image once. With the same seed and machine the weights are identical, whether or not the run
    was interrupted and resumed.

    Args:
        episodes: of the whole data set; their positions are the indices in ``settings.events``. Episodes with events
            are trained on, whatever their split, and not evaluated on.
        partial: file from which a paused or interrupted run resumes, such as ``partial_path`` of its checkpoint.

    Raises:
        BadInput: a pattern matches nothing, a slice or event does not fit, or there is no training episode.
    """
    settings = settings or FineTune()
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    began = time.monotonic()
    filter_ = copy.deepcopy(base.filter).to(device)
    trained = select_parameters(filter_, settings.train, settings.freeze)
    settings.check_fit(filter_)
    if settings.calibrate and not {id(p) for p in noise_parameters(filter_)} <= {id(p) for p in trained.values()}:
        raise BadInput("calibrate needs the noise of dynamics and sensors to be trained; add noise-only to --train")
    frozen = freeze(filter_, trained)
    frozen_digest = digest(filter_, frozen)
    groups, events = split_episodes(episodes, settings.events)
    if settings.length > (longest := max(map(len, groups["train"]))):
        steps = plural(longest, "step")
        raise BadInput(f"windows of {settings.length} steps are longer than every training episode: {steps}")
    mixes, images = _mixes(filter_, groups, events, settings, device)
    key = cache_key(base=base.hash, settings=settings.to_json(), data=data_hash, versions=versions(), device=device)
    state = Partial(partial, key) if partial else None
    loop = FilterLoop(filter_, trained, settings, mixes["train"], mixes["val"])
    callbacks.on_start()
    with cached_encoders(filter_, images):
        before = validate(filter_, mixes["test"], 0, 0.0, settings)
        seconds = run_loop(loop, state, began, callbacks)
        if seconds is None:
            return None
        callbacks.on_evaluation()
        loop.restore_best()
        noise_factor = (
            calibrate_noise(filter_, lambda: _nees(filter_, mixes["val"], settings)) if settings.calibrate else 1.0
        )
        after = validate(filter_, mixes["test"], loop.best_step, 0.0, settings)
    assert digest(filter_, frozen) == frozen_digest, "a frozen parameter changed"
    filter_.eval().requires_grad_(False)
    record = {
        "command": command,
        "seed": settings.seed,
        "base": {"hash": base.hash, "name": base.name, "settings": settings.to_json()},
        "data_hash": data_hash,
        "episodes": {name: len(members) for name, members in groups.items()},
        "steps": loop.done,
        "best_step": loop.best_step,
        "noise_factor": noise_factor,
        "validations": [asdict(validation) for validation in loop.validations],
        "held_out": {"before": before.slices, "after": after.slices},
        "frozen": {"tensors": len(frozen), "before": frozen_digest, "after": digest(filter_, frozen)},
        "parts": loop.parameter_changes(),
        "seconds": round(seconds, 1),
        "versions": versions(),
        "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        **{key: base.record[key] for key in ("data_summary",) if key in base.record},
        "metrics": {"0": {"fused": evaluate(filter_, groups["test"]).to_dict()}},
    }
    return FineTuned(filter_.cpu(), record)


def _nees(filter_: Filter, mix: Mix, settings: FineTune) -> float:
    """Mean NEES / n over the slices, weighted as in the loss."""
    slices = validate(filter_, mix, 0, None, settings).slices
    return sum(share * float(slices[slice_.name]["nees"]) for slice_, share in settings.shares().items())


def _mixes(
    filter_: Filter,
    groups: dict[str, list[Episode]],
    events: dict[str, dict[int, list[StepRange]]],
    settings: FineTune,
    device: str,
) -> tuple[dict[str, Mix], Images]:
    """For each group of episodes the mix of slices, with image indices in place of images; and the images."""
    mixes = {
        name: Mix.from_shares(
            filter_.task, filter_.names, settings.shares(), members, settings.seed, events.get(name), device
        )
        for name, members in groups.items()
    }
    indexed, images = index_images([mix.steps for mix in mixes.values()])
    return {name: mix.with_steps(steps) for (name, mix), steps in zip(mixes.items(), indexed, strict=True)}, images


def run_loop(loop: FineTuneLoop, state: Partial | None, began: float, callbacks: Callbacks) -> float | None:
    """Runs the loop, from its saved state if there is one; returns the seconds spent in total, None if paused."""
    spent = 0.0
    if state is not None and (saved := state.load()) is not None:
        spent = loop.restore(*saved)
        callbacks.on_resume(loop.done)
    else:
        loop.validate()
    for validation in loop.validations:
        callbacks.on_validation(validation)
    while not loop.finished:
        paused = callbacks.stop()
        if not paused:
            callbacks.report(loop.done + 1, loop.settings.steps, loop.step())
            if loop.validation_due:
                callbacks.on_validation(loop.validate())
        if state is not None and (paused or loop.validation_due):
            state.save(*loop.state(spent + time.monotonic() - began))
        if paused:
            return None
    return spent + time.monotonic() - began


def split_episodes(
    episodes: Sequence[Episode], events: Sequence[StepRange]
) -> tuple[dict[str, list[Episode]], dict[str, dict[int, list[StepRange]]]]:
    """Episodes to train on, validate on and test on; and the events of the first group by position in it.

    Raises BadInput for an event outside of the episodes.
    """
    by_episode: dict[int, list[StepRange]] = {}
    for event in events:
        if event.episode >= len(episodes):
            raise BadInput(f"Episode {event.episode} is not in the data, which has episodes 0 to {len(episodes) - 1}.")
        steps = len(episodes[event.episode])
        if event.first >= steps or (event.last or 0) > steps:
            where = "begins" if event.first >= steps else "ends"
            raise BadInput(f"event {event} {where} after its episode's {plural(steps, 'step')}")
        by_episode.setdefault(event.episode, []).append(event)
    split = {name: [i for i, e in enumerate(episodes) if e.split == name and i not in by_episode] for name in SPLITS}
    train = sorted([*split["train"], *by_episode])
    if not train:
        raise no_training_episodes(episodes[0].task, (e.split for e in episodes))
    val = split["val"]
    if not val:
        val = [i for i in train if i not in by_episode][::8] or train
        train = [i for i in train if i not in val or i in by_episode] or train
    indices = {"train": train, "val": val, "test": split["test"] or val}
    groups = {name: [episodes[i] for i in members] for name, members in indices.items()}
    return groups, {"train": {train.index(i): ranges for i, ranges in by_episode.items()}}

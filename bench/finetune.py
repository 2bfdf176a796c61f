"""Time of a fine-tuning step, with cached outputs of frozen encoders and without."""

from __future__ import annotations

import copy
from collections.abc import Callable

import subject
from subject import NAMES, Row

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.finetuning.batch_mix import Mix
from beliefscope.filters.finetuning.loop import FilterLoop
from beliefscope.filters.finetuning.module_selection import freeze, select_parameters
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.filters.training.encoder_cache import cached_encoders, index_images

BARS = {"weights-only": ">= 5 x", "haptics-only": "", "noise-only": ""}
REPETITIONS = 5


def measure() -> list[Row]:
    """One step of default size, forward and backward, of the push filters, with the same windows."""
    rows: list[Row] = []
    with open_dataset(sample_path("push")) as data:
        episodes = [data[i] for i in range(8)]
    settings = FineTune(mix=((Slice("blackout", Faults.parse("blackout=0.4")), 1.0),))
    for name in NAMES:
        filter_ = load_checkpoint(pretrained_path("push", name)).filter
        mix = Mix.from_shares(filter_.task, filter_.names, settings.shares(), episodes, settings.seed)
        full_filter = copy.deepcopy(filter_)
        full = backward(FilterLoop(full_filter, select_parameters(full_filter), settings, mix, mix))
        (steps,), images = index_images([mix.steps])
        for preset, bar in BARS.items():
            trained = select_parameters(filter_, [preset])
            freeze(filter_, trained)
            with cached_encoders(filter_, images):
                cached = backward(FilterLoop(filter_, trained, settings, mix.with_steps(steps), mix.with_steps(steps)))
                fast, slow, ratio = subject.alternate(cached, full, REPETITIONS)
            figures = f"{1e3 * fast:.0f} ms, without cache {1e3 * slow:.0f} ms, {ratio:.1f} x"
            rows.append((f"{name}, {preset}", figures, bar))
    return rows


def backward(loop: FilterLoop) -> Callable[[], None]:
    """Return a function for one forward and backward pass of the windows of step 0."""

    def run() -> None:
        for parameter in loop.trained.values():
            parameter.requires_grad_(True)
            parameter.grad = None
        loop.step_loss(0).backward()

    return run

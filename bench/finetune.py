"""What a step of fine-tuning costs: with frozen encoders looked up, beside everything in the graph."""

from __future__ import annotations

import copy
from collections.abc import Callable

import subject
from subject import NAMES, Row

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.filters.finetuning.batch_mix import Mix
from beliefscope.filters.finetuning.finetune import FineTune
from beliefscope.filters.finetuning.loop import Tuning
from beliefscope.filters.finetuning.module_selection import chosen, freeze
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.filters.training.encoder_cache import numbered, recalling

BARS = {"weights-only": ">= 5 x", "haptics-only": "", "noise-only": ""}
TURNS = 5


def measure() -> list[Row]:
    """One step of the default size, forward and backward, of the push filters; the same windows either way."""
    rows: list[Row] = []
    with open_dataset(sample_path("push")) as data:
        episodes = [data[i] for i in range(8)]
    settings = FineTune(mix=((Slice("blackout", Faults.parse("blackout=0.4")), 1.0),))
    for name in NAMES:
        filter_ = load_checkpoint(shipped("push", name)).filter
        mix = Mix.of(filter_.task, filter_.names, settings.shares(), episodes, settings.seed)
        whole = copy.deepcopy(filter_)
        in_graph = backward(Tuning(whole, chosen(whole), settings, mix, mix))
        (steps,), pictures = numbered([mix.steps])
        for preset, bar in BARS.items():
            trained = chosen(filter_, [preset])
            freeze(filter_, trained)
            with recalling(filter_, pictures):
                recalled = backward(Tuning(filter_, trained, settings, mix.on(steps), mix.on(steps)))
                fast, slow, ratio = subject.in_turn(recalled, in_graph, TURNS)
            figures = f"{1e3 * fast:.0f} ms beside {1e3 * slow:.0f} ms, {ratio:.1f} x"
            rows.append((f"{name}, {preset}, beside everything", figures, bar))
    return rows


def backward(tuning: Tuning) -> Callable[[], None]:
    """One forward and backward pass of the windows of step 0."""

    def run() -> None:
        for parameter in tuning.trained.values():
            parameter.requires_grad_(True)
            parameter.grad = None
        tuning.loss_of(0).backward()

    return run

"""Default fine-tuning of every filter, and the effect of every offered preset."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.catalog import architecture, build, filters_of
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.batch_mix import Mix
from beliefscope.filters.finetuning.defaults import default_settings, reason
from beliefscope.filters.finetuning.loop import FilterLoop, Validation
from beliefscope.filters.finetuning.module_selection import freeze, presets, select_parameters
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import Slice, parse_slices
from beliefscope.filters.subsets import input_modalities

pytestmark = pytest.mark.slow

FILTERS = [(task, name) for task in ("door", "push") for name in filters_of(find_task(task))]
FIRST = ("crossmodal-ekf", "feature-pf", "information-ekf", "lstm")
"""Each kind of filter once; the others are tested by ``make check-all`` only."""


@pytest.mark.first(10)
@pytest.mark.parametrize(("task", "name"), FILTERS)
def test_defaults_train_a_model_of_the_filter_on_a_fault_of_its_sensors(task: str, name: str) -> None:
    filter_ = build(architecture(task, name))
    settings = default_settings(filter_)
    ((slice_, _),) = settings.mix
    (preset,) = settings.train
    modality = input_modalities(filter_)[0]
    distrusting = name.endswith("-pf") or name in ("crossmodal-ekf", "crossmodal-ukf")
    assert preset == ("reliability-only" if distrusting else f"{modality}-only")
    assert preset in presets(filter_)
    assert 0 < len(select_parameters(filter_, settings.train)) <= len(list(filter_.parameters()))
    keys = {key for fault in slice_.faults for key in fault.keys(filter_.task)}
    assert keys <= set(filter_.task.modalities[modality])
    assert slice_.name in reason(filter_)
    assert parse_slices([slice_.name], (), filter_.task) == [slice_]


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "name",
    [name if name in FIRST else pytest.param(name, marks=pytest.mark.long) for name in filters_of(find_task("door"))],
)
def test_every_offered_preset_has_a_gradient(name: str, short_episodes: Callable[..., list[Episode]]) -> None:
    filter_ = build(architecture("door", name))
    settings = FineTune(length=6, windows=2, particles=5)
    mix = Mix.from_shares(filter_.task, filter_.names, settings.shares(), short_episodes("door", [0], 8), 0)
    for preset in presets(filter_):
        trained = select_parameters(filter_, [preset])
        freeze(filter_, trained)
        for parameter in trained.values():
            parameter.grad = None
        FilterLoop(filter_, trained, settings, mix, mix).step_loss(0).backward()
        assert any(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in trained.values()), preset


def test_weights_that_lose_accuracy_on_clean_data_are_not_kept(
    short_episodes: Callable[..., list[Episode]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second validation has the best score, but twice the error on clean data; the third beats the base as well."""
    errors = iter([(1.0, 10.0), (2.0, 0.1), (1.1, 5.0)])

    def validate(filter_: Filter, mix: Mix, step: int, loss: float | None, settings: FineTune) -> Validation:
        by_slice = zip(("clean", "blackout"), next(errors), strict=True)
        return Validation(step, loss, {name: {"error": error, "nll": None} for name, error in by_slice})

    monkeypatch.setattr("beliefscope.filters.finetuning.loop.validate", validate)
    filter_ = build(architecture("door", "haptics-ekf"))
    slice_ = Slice("blackout", Faults.parse("blackout=1"))
    settings = FineTune(length=6, windows=2, mix=((slice_, 1.0),), clean_weight=0.1)
    mix = Mix.from_shares(filter_.task, filter_.names, settings.shares(), short_episodes("door", [0], 8), 0)
    loop = FilterLoop(filter_, select_parameters(filter_), settings, mix, mix)
    best = []
    for step in range(3):
        loop.done = step
        loop.validate()
        best.append(loop.best_step)
    assert loop.validations[1].score < loop.validations[2].score < loop.validations[0].score
    assert best == [0, 0, 2]

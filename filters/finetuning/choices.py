"""What can be chosen for fine-tuning a filter: modules, presets, data slices and settings, as JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.finetuning.defaults import default_settings, reason
from beliefscope.filters.finetuning.module_selection import (
    module_change,
    module_tree,
    preset_help,
    presets,
    select_parameters,
    within,
)
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import CLEAN, Slice, fault_slices, standard_slices
from beliefscope.filters.finetuning.success import criterion_slices


@dataclass(frozen=True)
class ModuleInfo:
    """A module of a filter. gradient, change: of the fine-tuning that wrote the checkpoint; None without one."""

    name: str
    kind: str
    description: str
    parameters: int
    depth: int
    gradient: float | None
    change: float | None


@dataclass(frozen=True)
class PresetInfo:
    """A preset. help: its effect. trains: names of parameters."""

    name: str
    help: str
    trains: list[str]


@dataclass(frozen=True)
class SliceInfo:
    """A slice of a data set (``filters.finetuning.slices``)."""

    name: str
    faults: list[dict[str, Any]]
    contact: bool | None
    only: list[str]
    text: str

    @classmethod
    def from_slice(cls, slice_: Slice) -> SliceInfo:
        return cls(**slice_.to_json(), text=str(slice_))


EXTERNAL = (
    "The torch module of an external filter is fine-tuned on the command line, on a loss of its own file "
    "(docs/finetune.md): beliefscope finetune {task} --filter FILE.py:FUNCTION --data DATA -o tuned.safetensors"
)
"""Why an external filter has no choices."""


@dataclass(frozen=True)
class Choices:
    """Options for fine-tuning a filter.

    why_not: why it cannot be fine-tuned, or None. settings: the defaults. reason: why they are the defaults.
    criterion_slices: names of slices that a success criterion can have besides those trained on.
    """

    why_not: str | None
    modules: Sequence[ModuleInfo]
    presets: Sequence[PresetInfo]
    slices: Sequence[SliceInfo]
    criterion_slices: Sequence[str]
    settings: dict[str, Any]
    reason: str


def choices(checkpoint: Checkpoint) -> Choices:
    """The options for fine-tuning a filter."""
    if isinstance(checkpoint, ExternalFilter):
        return Choices(EXTERNAL.format(task=checkpoint.task.name), [], [], [], [], FineTune().to_json(), "")
    filter_ = checkpoint.filter
    changes = checkpoint.record.get("parts", {})  # of the fine-tuning that wrote this checkpoint
    modules = []
    for node in module_tree(filter_):
        if node.name and node.parameters:
            changed = any(within(key, node.name) for key in changes)
            sizes = module_change(node.name, changes) if changed else {"gradient": None, "change": None}
            modules.append(ModuleInfo(node.name, node.kind, node.description, node.parameters, node.depth, **sizes))
    parameters = [name for name, _ in filter_.named_parameters()]
    trained = {name: set(select_parameters(filter_, [name])) for name in presets(filter_)}
    slices = fault_slices(checkpoint.task, filter_.names)
    slices += [s for s in standard_slices(checkpoint.task) if s != CLEAN and set(s.only) <= set(filter_.names)]
    return Choices(
        None,
        modules,
        [
            PresetInfo(name, preset_help(name), [key for key in parameters if key in names])
            for name, names in trained.items()
        ],
        [SliceInfo.from_slice(slice_) for slice_ in slices],
        [slice_.name for slice_ in criterion_slices(checkpoint.task, filter_.names)],
        default_settings(filter_).to_json(),
        reason(filter_),
    )

"""The next action of a diagnosis: what a user does about a cause, with the command that does it."""

from __future__ import annotations

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.task import display_name
from beliefscope.datasets.text import capitalised
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.filters.finetuning.external import has_loss
from beliefscope.filters.names import PRETRAINED, is_code
from beliefscope.filters.subsets import modalities_of
from beliefscope.inspect.diagnosis.cause import Cause, Command, matches

CONVENTIONS = "test the signs, scales and axes of its inputs: diagnostic Conventions of the inputs"


def next_action(cause: Cause, checkpoint: Checkpoint) -> str:
    """The next action of a cause; none for the filter if the cause is in a sensor that it does not use."""
    if is_unused(cause, checkpoint):
        sensor = display_name(cause.component)
        return f"This filter does not use the {sensor} sensor and is unaffected; repair the sensor for other filters."
    if cause.command is None:
        return cause.next
    if isinstance(checkpoint, ExternalFilter) and not (cause.command.name == "finetune" and _is_trainable(checkpoint)):
        return cause.by_hand
    return f"{cause.next}: `{command_line(cause.command, checkpoint)}`."


def command_line(command: Command, checkpoint: Checkpoint) -> str:
    """The command with its task, filter and data."""
    words = [f"beliefscope {command.name} {checkpoint.task.name} --filter {_argument(checkpoint)}"]
    if command.train and not isinstance(checkpoint, ExternalFilter):  # its loss selects what is trained
        words.append(f"--train {command.train}")
    words.append(command.options)
    if "--data" not in command.options:
        words.append(_data(checkpoint))
    if command.name == "finetune":
        words.append("-o tuned.safetensors")
    return " ".join(filter(None, words))


def _is_trainable(checkpoint: ExternalFilter) -> bool:
    """Whether the filter has parameters and, if its file is known, a loss in it."""
    source = checkpoint.source
    if isinstance(checkpoint, UnavailableFilter) or (is_code(source) and not has_loss(source)):
        return False
    return any(True for _ in getattr(checkpoint.adapter.module, "parameters", tuple)())


def _argument(checkpoint: Checkpoint) -> str:
    """A checkpoint as the value of ``--filter``: the name of a pretrained one, else that of its file, or its source."""
    if isinstance(checkpoint, ExternalFilter):
        return checkpoint.source if ":" in checkpoint.source else "FILE.py:FUNCTION"  # of a filter of Python
    path = checkpoint.path
    return checkpoint.name if path is None or path.parent.resolve() == PRETRAINED.resolve() else path.name


def _data(checkpoint: Checkpoint) -> str:
    """The option for the data in a command; empty for a task with a sample set, which is the default."""
    return "" if checkpoint.task.name in TASKS else "--data DATA"


def is_unused(cause: Cause, checkpoint: Checkpoint) -> bool:
    """Whether a cause is in a sensor that a filter does not use, neither as a modality nor in the controls."""
    modality = next((m for m, keys in checkpoint.task.modalities.items() if cause.component in (m, *keys)), None)
    changes_controls = matches(cause.consequences, "dynamics error//all")
    return modality is not None and not changes_controls and modality not in modalities_of(checkpoint)


def search_action(checkpoint: Checkpoint, count: int, reports: bool = True) -> str:
    """The next action without a probable cause.

    count: number of all episodes. reports: whether the filter reports innovations or particles.
    """
    if count == 1:
        return "Diagnose more episodes, such as all held-out ones."
    external = isinstance(checkpoint, ExternalFilter)
    if isinstance(checkpoint, UnavailableFilter):
        return "Diagnose the filter itself, as an external filter (docs/own_filter.md), which shows its equations."
    start = f"{capitalised(CONVENTIONS)}, or search" if external else "Search"
    if external and not reports:
        start = f"Return its predictions and innovations, which show faults of its equations, {CONVENTIONS}, or search"
    command = command_line(Command("slices"), checkpoint)
    return f"{start} for data slices with large errors, in the tab Failures or with `{command}`."

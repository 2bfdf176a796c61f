"""The filter and the episodes that traces are from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.filters.names import is_code
from beliefscope.filters.open_filter import open_filter
from beliefscope.inspect.traces.data import Trace


def describe(trace: Trace) -> dict[str, Any]:
    """Filter, episode, faults, seed and hashes of a trace, as JSON values."""
    return {
        "task": trace.task.name,
        "filter": trace.filter,
        "episode": trace.episode_index,
        "steps": len(trace),
        "faults": trace.faults.to_json(),
        "seed": trace.seed,
        "checkpoint_hash": trace.checkpoint_hash,
        "data_hash": trace.data_hash,
    }


def checkpoint_of(traces: Sequence[Trace], files: Sequence[Path], filter_: str = "") -> Checkpoint | None:
    """The checkpoint of traces of one filter, if available.

    Args:
        files: of the traces, for messages.
        filter_: name or path of the filter; if empty, the pretrained filter with the traces' checkpoint hash.

    Raises:
        BadInput: the traces are of different checkpoints, or not of the given filter.
    """
    first = traces[0]
    for file, trace in zip(files, traces, strict=True):
        if trace.checkpoint_hash != first.checkpoint_hash:
            raise BadInput(f"{file} and {files[0]} are from different checkpoints; give traces of one filter")
    if filter_:
        checkpoint = open_filter(first.task, filter_)
        if checkpoint.hash != first.checkpoint_hash:
            changed = is_code(filter_) and checkpoint.name == first.filter
            own = ": its code has changed, or Python built the filter of the trace" if changed else ""
            name = f"{first.filter}, checkpoint {first.checkpoint_hash[:12]}"
            raise BadInput(f"{files[0]} is a run of {name}, not of {filter_!r}{own}")
        return checkpoint
    try:
        checkpoint = load_checkpoint(pretrained_path(first.task, first.filter))
    except BadInput:
        return None
    return checkpoint if checkpoint.hash == first.checkpoint_hash else None


def unavailable_filter(trace: Trace) -> UnavailableFilter:
    """Stands for the filter of a trace without a checkpoint."""
    return UnavailableFilter(trace.filter, trace.checkpoint_hash, trace.task)


def reproducible(traces: Sequence[Trace], data: Path | None) -> set[int]:
    """Indices of the traces that a run over this data reproduces: same episode and seed, no interventions.

    Args:
        data: file or folder; None for the sample dataset. Runs have the seed of the first trace and 300 particles.
    """
    task = traces[0].task
    try:
        with open_dataset(sample_path(task) if data is None else data, task) as episodes:
            return {
                i
                for i, trace in enumerate(traces)
                if trace.episode_index < len(episodes)
                and episodes[trace.episode_index].digest() == trace.data_hash
                and trace.seed == traces[0].seed
                and trace.settings.get("particles", 300) == 300
                and not trace.settings.get("edits")
            }
    except BadInput:
        return set()

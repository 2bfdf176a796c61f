"""The healthy record of a command's ``--profile-from``: clean data that a filter runs over, or recorded runs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from beliefscope.app.cli import console
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
    from beliefscope.inspect.trace import Trace


def record_for_runs(
    traces: Sequence[Trace],
    places: Sequence[str],
    filter_: str,
    source: Path | None,
    alarm_rate: float | None = None,
    workspace: Path | None = None,
) -> tuple[list[Trace], Checkpoint, HealthyProfile]:
    """Runs with one definition of their task, their filter, which may be unavailable, and its healthy record.

    Args:
        places: of the runs, for messages. filter_: as for ``checkpoint_of``.
        source: recorded runs, or data that the filter runs over. Default: the record of the filter itself, or that
            which the workspace keeps of it.

    Raises BadInput as ``comparable`` and ``record_of_data``, and if an unavailable filter would have to run.
    """
    from beliefscope.app.workspace.healthy_records import with_kept_record
    from beliefscope.filters.external.unavailable import UnavailableFilter
    from beliefscope.filters.names import is_run
    from beliefscope.inspect.healthy import recorded_profile
    from beliefscope.recordings.open_trace import recorded_runs
    from beliefscope.recordings.recorded_diagnosis import comparable

    clean = recorded_runs(source) if source and is_run(str(source)) else []
    runs, clean, checkpoint = comparable(traces, clean, [*places, *[str(source)] * len(clean)], filter_)
    if clean:
        _warn_of_overlap((trace.episode for trace in clean), (trace.episode for trace in runs))
        with console.progress("Measuring the healthy record") as advance:
            return runs, checkpoint, recorded_profile(checkpoint, clean, str(source), advance)
    if source is None and workspace is not None:
        checkpoint = with_kept_record(checkpoint, workspace)
    if isinstance(checkpoint, UnavailableFilter) and (source is not None or checkpoint.healthy_profile is None):
        raise BadInput(
            "recorded runs need a healthy record: give a folder of at least 10 recorded runs without a fault, "
            "--profile-from DIR, or the filter of the runs, --filter"
        )
    return runs, checkpoint, record_of_data(checkpoint, source, [trace.episode for trace in runs], alarm_rate)


def record_of_data(
    checkpoint: Checkpoint,
    source: Path | None,
    diagnosed: Collection[Episode],
    alarm_rate: float | None = None,
    injected: bool = False,
) -> HealthyProfile:
    """The healthy record of a filter, or of its runs over the held-out episodes of ``source``.

    Raises BadInput, before the runs, if these are too few for the diagnosis. Warns if some are ``diagnosed``, unless
    with ``injected`` faults: a fault that the record has as well does not show.
    """
    from beliefscope.datasets.store import open_dataset
    from beliefscope.inspect.diagnosis.case import checked_alarm_rate
    from beliefscope.inspect.diagnosis.diagnose import required_profile
    from beliefscope.inspect.healthy import profile_of

    if source is None:
        return required_profile(checkpoint)
    with open_dataset(source) as data, console.progress("Measuring the healthy record") as advance:
        indices = data.held_out()
        checked_alarm_rate(len(indices), len(diagnosed), alarm_rate, len(data))
        advance(0.0)
        episodes = [data[index] for index in indices]
        _warn_of_overlap(episodes, () if injected else diagnosed)
        return profile_of(checkpoint, episodes, str(source), progress=advance, indices=indices)


def _warn_of_overlap(record: Iterable[Episode], diagnosed: Iterable[Episode]) -> None:
    from beliefscope.inspect.healthy import overlap_warning

    if warning := overlap_warning(record, diagnosed):
        console.note(f"Warning: {warning}")

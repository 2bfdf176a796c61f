"""Diagnosis of recorded runs, such as those of imported logs, by comparison with healthy ones."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnosis.cause import Diagnosis
from beliefscope.inspect.diagnosis.diagnose import diagnose_traces
from beliefscope.inspect.healthy import overlap_warning, recorded_profile
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.provenance import checkpoint_of, unavailable_filter
from beliefscope.recordings.open_trace import of_one_task, recorded_runs, with_distinct_indices

Runs = str | Path | Sequence[Trace]


def diagnose_runs(runs: Runs, profile_from: Runs, *, alarm_rate: float | None = None) -> Diagnosis:
    """Name the probable cause of a fault in recorded runs, as they are (docs/diagnose.md#recorded-runs).

    Args:
        runs: a trace, live run or recording, a folder of them, or traces.
        profile_from: at least 10 recorded runs without a fault, of the same task.
        alarm_rate: as for ``diagnose``.

    Raises BadInput for runs of several tasks or filters, and for too few healthy ones.
    """
    (traces, places), (clean, others) = _loaded(runs, "runs"), _loaded(profile_from, "profile_from")
    traces, clean, checkpoint = comparable(traces, clean, [*places, *others])
    if warning := overlap_warning((t.episode for t in clean), (t.episode for t in traces)):
        warnings.warn(warning, stacklevel=2)
    profile = recorded_profile(checkpoint, clean, others[0])
    return diagnose_traces(checkpoint, traces, alarm_rate=alarm_rate, profile=profile)


def comparable(
    traces: Sequence[Trace], clean: Sequence[Trace], places: Sequence[str], filter_: str = ""
) -> tuple[list[Trace], list[Trace], Checkpoint]:
    """Runs and healthy ones with one definition of their task, and their filter, which may be unavailable.

    Args:
        places: of all runs, for messages. filter_: as for ``checkpoint_of``.

    The filter of runs whose healthy ones are of another version is unavailable.
    """
    every = of_one_task([*traces, *clean], places)
    traces, clean = every[: len(traces)], every[len(traces) :]
    first, version = traces[0], traces[0].checkpoint_hash
    checkpoint = checkpoint_of(traces, [Path(place) for place in places[: len(traces)]], filter_)
    if checkpoint is None or (clean and clean[0].checkpoint_hash != version):
        checkpoint = unavailable_filter(first)
    return traces, clean, checkpoint


def _loaded(runs: Runs, name: str) -> tuple[list[Trace], list[str]]:
    """Traces, and their places for messages."""
    if isinstance(runs, str | Path):
        traces, place = recorded_runs(Path(runs)), str(runs)
    else:
        traces, place = with_distinct_indices(runs), name
    if not traces:
        raise BadInput(f"{place} has no recorded runs")
    return traces, [place] * len(traces)

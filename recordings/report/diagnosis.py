"""The diagnosis at the start of a report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnosis.cause import Diagnosis
from beliefscope.inspect.diagnosis.diagnose import diagnose_traces
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.provenance import unavailable_filter


@dataclass(frozen=True)
class ReportedDiagnosis:
    """The diagnosis of the traces, or the reason why there is none.

    Attributes:
        link: permalink of the step that shows the first cause best, or empty.
    """

    result: Diagnosis | None
    reason: str = ""
    link: str = ""


def report_diagnosis(
    traces: Sequence[Trace],
    checkpoint: Checkpoint | None,
    profile: HealthyProfile | None,
    link: Callable[[int, int], str],
    progress: Callable[[float], None],
) -> ReportedDiagnosis:
    """Diagnose the runs of the traces.

    Args:
        checkpoint: of the filter; without it no cause is undone.
        profile: healthy record; by default that of the checkpoint.
        link: (index of a trace, step) -> permalink.
    """
    if checkpoint is None and profile is None:
        return ReportedDiagnosis(None, "the filter's checkpoint is not available")
    indices = [trace.episode_index for trace in traces]
    if len(set(indices)) < len(indices):
        return ReportedDiagnosis(None, "an episode has several traces")
    if any(trace.settings.get("edits") or trace.settings.get("standalone") for trace in traces):
        return ReportedDiagnosis(None, "interventions changed the run")
    first = traces[0]
    filter_ = checkpoint or unavailable_filter(first)
    try:
        particles = int(first.settings.get("particles", 300))
        result = diagnose_traces(
            filter_, traces, seed=first.seed, particles=particles, profile=profile, progress=progress
        )
    except BadInput as error:
        return ReportedDiagnosis(None, str(error))
    deviations = () if result.state == "healthy" else result.deviations
    evidence = result.listed[0].evidence if result.listed else deviations
    moments = [(indices.index(e.episode), e.step or 0) for e in evidence if e.episode is not None]
    return ReportedDiagnosis(result, link=link(*moments[0]) if moments else "")

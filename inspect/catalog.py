"""Catalog of diagnostics. A new diagnostic is a module with an ``Entry`` that is listed here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics import (
    consistency,
    conventions,
    ensemble,
    error_sources,
    errors,
    fusion_efficiency,
    gates,
    kalman_equations,
    likelihood_maps,
    particle_health,
    saliency,
    shapley,
    standalone_modalities,
    weight_audit,
)
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.trace import Trace

ENTRIES: tuple[Entry, ...] = (
    likelihood_maps.ENTRY,
    weight_audit.ENTRY,
    standalone_modalities.ENTRY,
    fusion_efficiency.ENTRY,
    consistency.ENTRY,
    gates.ENTRY,
    kalman_equations.ENTRY,
    errors.ENTRY,
    error_sources.ENTRY,
    particle_health.ENTRY,
    ensemble.ENTRY,
    shapley.ENTRY,
    saliency.ENTRY,
    conventions.ENTRY,
)

DIAGNOSTICS: dict[str, Entry] = {entry.name: entry for entry in ENTRIES}
"""Entries by name, in display order."""

SLOW = "slow diagnostic; include it with --all"
"""Reason for the absence of a diagnostic that applies, but takes more than two seconds."""


def run_diagnostics(
    traces: Sequence[Trace],
    checkpoint: Checkpoint | None,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    slow: bool = False,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[dict[str, Diagnostic], dict[str, str]]:
    """Run diagnostics on traces of one filter.

    Args:
        options: names of the diagnostics -> their options; default: all. slow: whether to run slow ones.

    Returns:
        Results by name, and the reason for each diagnostic without one.

    Raises BadInput for an invalid value of an option.
    """
    options = {name: {} for name in DIAGNOSTICS} if options is None else options
    results: dict[str, Diagnostic] = {}
    reasons: dict[str, str] = {}
    for index, (name, values) in enumerate(options.items()):
        entry = DIAGNOSTICS[name]
        reason = next(filter(None, (entry.refusal(trace, checkpoint) for trace in traces)), None)
        if reason is None and entry.slow and not slow:
            reason = SLOW
        if reason is not None:
            reasons[name] = reason
        else:
            share = {"progress": lambda part, index=index: progress((index + part) / len(options))}
            try:
                results[name] = entry(traces, checkpoint, **values, **(share if entry.takes_progress else {}))
            except BadInput as error:  # which only the attempt shows
                if values:
                    raise
                reasons[name] = str(error)
        progress((index + 1) / len(options))
    return results, reasons


def reason_text(reason: str) -> str:
    """Why a diagnostic has no result, in a report of all of them: it is slow, or not available."""
    return reason if reason == SLOW else f"not available: {reason}"


def quick(trace: Trace, checkpoint: Checkpoint | None = None) -> dict[str, Diagnostic]:
    """Compute all applicable diagnostics of a trace that are not slow, by name."""
    return run_diagnostics([trace], checkpoint)[0]

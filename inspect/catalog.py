"""Catalog of diagnostics. A new diagnostic is a module with an ``Entry`` that is listed here."""

from __future__ import annotations

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics import (
    consistency,
    likelihood_maps,
    particle_health,
    saliency,
    shapley,
    weight_audit,
)
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.trace import Trace

ENTRIES: tuple[Entry, ...] = (
    likelihood_maps.ENTRY,
    weight_audit.ENTRY,
    consistency.ENTRY,
    particle_health.ENTRY,
    shapley.ENTRY,
    saliency.ENTRY,
)

DIAGNOSTICS: dict[str, Entry] = {entry.name: entry for entry in ENTRIES}
"""Entries by name, in display order."""


def quick(trace: Trace, checkpoint: Checkpoint | None = None) -> dict[str, Diagnostic]:
    """Compute all applicable diagnostics of a trace that are not slow, by name."""
    return {
        name: entry([trace], checkpoint)
        for name, entry in DIAGNOSTICS.items()
        if not entry.slow and entry.refusal(trace, checkpoint) is None
    }

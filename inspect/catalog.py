"""The diagnostics that there are. A new one is a module with an ``Entry``, and its line here."""

from __future__ import annotations

from beliefscope.inspect import consistency, maps, particles, weights
from beliefscope.inspect.diagnostic import Entry

ENTRIES: tuple[Entry, ...] = (maps.ENTRY, weights.ENTRY, consistency.ENTRY, particles.ENTRY)

DIAGNOSTICS: dict[str, Entry] = {entry.name: entry for entry in ENTRIES}
"""By name, in the order in which they are shown."""

"""The catalog of causes. To add one, write a file in ``causes/`` and list it here."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause

CAUSES: tuple[Cause, ...] = ()
"""All causes, by component."""

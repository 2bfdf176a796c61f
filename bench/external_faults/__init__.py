"""Planted faults of external filters and of their data, in four small tasks (docs/diagnose.md)."""

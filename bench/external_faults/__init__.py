"""Planted faults of external filters and of their data, in six small tasks (docs/diagnose.md)."""

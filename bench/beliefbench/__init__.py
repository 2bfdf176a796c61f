"""Planted faults of multimodal filters, and a score card for tools that diagnose them (docs/beliefbench.md)."""

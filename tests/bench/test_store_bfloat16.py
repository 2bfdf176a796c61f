"""Checkpoints stored as bfloat16: half the size, and loaded as the nearest values in 32 bits."""

from __future__ import annotations

from pathlib import Path

import torch
from store_bfloat16 import VALUES, halve

from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path


def test_matrices_are_rounded_and_nothing_else_changes(tmp_path: Path) -> None:
    original = pretrained_path("push", "crossmodal-ekf")
    path = tmp_path / original.name
    path.write_bytes(original.read_bytes())
    halve(path)
    before, after = load_checkpoint(original), load_checkpoint(path)
    assert after.hash != before.hash
    assert (after.name, after.record, after.task) == (before.name, before.record, before.task)
    assert path.stat().st_size < 0.55 * original.stat().st_size
    rounded = 0
    weights = after.filter.state_dict()
    for key, value in before.filter.state_dict().items():
        assert weights[key].dtype == value.dtype == torch.float32
        if value.ndim > 1 and value.numel() >= VALUES:
            torch.testing.assert_close(weights[key], value, rtol=2**-8, atol=0.0)
            assert not torch.equal(weights[key], value), key
            rounded += 1
        else:
            assert torch.equal(weights[key], value), key
    assert rounded > 5
    halve(path)  # again: nothing is left to round
    assert all(torch.equal(value, weights[key]) for key, value in load_checkpoint(path).filter.state_dict().items())

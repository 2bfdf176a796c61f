"""Outages and blur of images: moments of the Markov chain and of the kernel."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.datasets.faults.faults import FAULTS


def test_outages_have_the_requested_share_and_mean_duration() -> None:
    white = np.full((200_000, 1, 1), 255, np.uint8)
    for fraction, seconds in ((0.3, 1.0), (0.8, 3.0)):
        fault = FAULTS["image_outage"](fraction=fraction, seconds=seconds)
        lost = fault.apply(white, 0.1, np.random.default_rng(0))[:, 0, 0] == 0
        begins = np.count_nonzero(lost[1:] & ~lost[:-1])
        assert lost.mean() == pytest.approx(fraction, rel=0.05)
        assert 0.1 * lost.sum() / begins == pytest.approx(seconds, rel=0.05)
    for fraction in (0.0, 1.0):
        fault = FAULTS["image_outage"](fraction=fraction)
        assert (fault.apply(white[:99], 0.1, np.random.default_rng(0)) == 255 * (1 - fraction)).all()


def test_blur_keeps_the_mean_and_spreads_a_point() -> None:
    point = np.zeros((1, 33, 33))
    point[0, 16, 16] = 200.0
    blurred = FAULTS["image_blur"](std=2.0).apply(point, 0.1, np.random.default_rng(0))[0]
    offset = np.arange(33) - 16
    assert blurred.sum() == pytest.approx(200.0)
    assert (blurred.sum(0) * offset**2).sum() / 200.0 == pytest.approx(4.0, rel=0.01)
    assert (FAULTS["image_blur"](std=0.0).apply(point, 0.1, np.random.default_rng(0)) == point).all()
    flat = np.full((2, 32, 32), 77, np.uint8)
    assert (FAULTS["image_blur"](std=3.0).apply(flat, 0.1, np.random.default_rng(0)) == 77).all()


def test_shifts_move_the_content_and_repeat_the_border() -> None:
    images = np.random.default_rng(0).integers(0, 256, (2, 32, 32), np.uint8)
    shifted = FAULTS["image_shift"](x=3, y=-2).apply(images, 0.1, np.random.default_rng(0))
    assert (shifted[:, :-2, 3:] == images[:, 2:, :-3]).all()
    assert (shifted[:, :-2, :3] == images[:, 2:, :1]).all()
    assert (shifted[:, -2:] == shifted[:, -3:-2]).all()
    wide = FAULTS["image_shift"](x=100).apply(images, 0.1, np.random.default_rng(0))
    assert (wide == images[:, :, :1]).all()

"""Laws of the distance between hand and object in contact: a curve is recovered, and offsets leave it as expected."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import Generator

from beliefscope.inspect.statistics.contact_distance import contact_residual, fit_contact_distance

TWO_FINGERS = np.array([0.068, 0.0, 0.0, 0.0, 0.0, -0.005, 0.0, 0.001, 0.0])
"""m: cosines of the harmonics 1 to 4 and then their sines, an oval."""


@pytest.fixture
def rng() -> Generator:
    return np.random.default_rng(3)


def curve(angle: np.ndarray) -> np.ndarray:
    harmonics = angle[:, None] * np.arange(1, 5)
    return np.asarray(TWO_FINGERS[0] + np.cos(harmonics) @ TWO_FINGERS[1:5] + np.sin(harmonics) @ TWO_FINGERS[5:])


def pushes(rng: Generator, extra: float = 0.0, episodes: int = 60) -> list[np.ndarray]:
    """Displacements (20, 2) of one push each, from all directions, in m."""
    angles = rng.uniform(-np.pi, np.pi, episodes)[:, None] + rng.normal(0.0, 0.05, (episodes, 20))
    distances = [curve(angle) + extra for angle in angles]
    return [d[:, None] * np.stack([np.cos(a), np.sin(a)], 1) for d, a in zip(distances, angles, strict=True)]


@pytest.mark.parametrize("slipping", [False, True])
def test_the_curve_is_recovered(rng: Generator, slipping: bool) -> None:
    """To a tenth of a millimetre (the ridge shrinks it by its own share), also if every tenth contact slips off."""
    data = pushes(rng)
    if slipping:
        data[::10] = [push * 1.5 for push in data[::10]]
    fitted = fit_contact_distance(data)
    assert fitted is not None
    residuals = np.concatenate([contact_residual(push, fitted) for push in pushes(rng)])
    assert np.abs(residuals).max() < 3e-4
    assert np.median(np.abs(residuals)) < 1e-4


def test_a_larger_object_is_farther_in_every_direction(rng: Generator) -> None:
    fitted = fit_contact_distance(pushes(rng))
    assert fitted is not None
    medians = [np.median(contact_residual(push, fitted)) for push in pushes(rng, extra=0.004)]
    np.testing.assert_allclose(medians, 0.004, atol=3e-4)


def test_an_offset_of_the_labels_has_both_signs(rng: Generator) -> None:
    """Seen from direction u, labels with an offset d change the distance by -d.u to first order: the mean vanishes."""
    fitted = fit_contact_distance(pushes(rng))
    assert fitted is not None
    offset = np.array([0.003, -0.001])
    tested = pushes(rng, episodes=400)
    medians = np.array([np.median(contact_residual(push - offset, fitted)) for push in tested])
    directions = np.array([push.mean(0) / np.linalg.norm(push.mean(0)) for push in tested])
    slope = np.linalg.lstsq(directions, medians, rcond=None)[0]
    np.testing.assert_allclose(slope, -offset, atol=5e-4)
    assert abs(medians.mean()) < 5e-4
    assert np.abs(medians).mean() > 1.5e-3


def test_too_few_steps_have_no_curve() -> None:
    assert fit_contact_distance([]) is None
    assert fit_contact_distance([np.ones((9, 2))]) is None

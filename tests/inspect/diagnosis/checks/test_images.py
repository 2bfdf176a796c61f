"""Registration of images with those expected at the positions of the hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.diagnosis.checks.images import image_statistics, registration
from beliefscope.inspect.diagnosis.checks.windows import window_statistics
from beliefscope.inspect.healthy import sensor_record
from beliefscope.inspect.statistics.reference_images import Reference, normalised
from beliefscope.inspect.statistics.signals import Array

HEIGHT, WIDTH = 24, 32


def reference(rng: np.random.Generator) -> Reference:
    """Expected images that depend on the position of the hand (T, 2), drawn at random and smooth."""
    expected = ndimage.gaussian_filter(rng.normal(size=(6, HEIGHT, WIDTH)), (0, 2, 2))
    gray = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    return Reference("image", gray, gray, expected, np.stack([np.zeros(2), np.ones(2)]))


def scene(rng: np.random.Generator, healthy: Reference, shift: tuple[int, int]) -> tuple[Array, Array]:
    """(T, 2) hand positions, and (T, H, W) normalised images that are shifted by x and y pixels, with noise."""
    hand = rng.normal(size=(12, 2))
    images = np.tensordot(healthy.terms(hand), healthy.expected, axes=1)
    images = np.roll(images, shift[::-1], axis=(1, 2)) + 0.05 * rng.normal(size=images.shape)
    low, high = images.min(), images.max()
    return hand, normalised((255.0 * (images - low) / (high - low)).astype(np.uint8))


@pytest.mark.first(1)
@pytest.mark.parametrize("shift", [(0, 0), (-2, 4)])
def test_the_shift_is_that_of_the_largest_correlation_summed_over_the_images(shift: tuple[int, int]) -> None:
    from scipy import signal  # takes a second

    rng = np.random.default_rng(abs(shift[0]) + 10 * abs(shift[1]))
    healthy = reference(rng)
    hand, images = scene(rng, healthy, shift)
    total = np.zeros((2 * HEIGHT - 1, 2 * WIDTH - 1))
    for image, expected in zip(images, np.tensordot(healthy.terms(hand), healthy.expected, axes=1), strict=True):
        for axis in (0, 1):
            total += signal.correlate(np.gradient(image, axis=axis), np.gradient(expected, axis=axis), method="direct")
    rows, columns = HEIGHT // 4, WIDTH // 4
    middle = total[HEIGHT - 1 - rows : HEIGHT + rows, WIDTH - 1 - columns : WIDTH + columns]
    i, j = np.unravel_index(middle.argmax(), middle.shape)
    x, y = registration(healthy, hand, images)
    assert (round(x), round(y)) == (j - columns, i - rows) == shift


TASK = Task("table", (Component("x", "m"), Component("y", "m")), {"image": (12, 12)}, {"image": ("image",)}, 0, 0.1)


def film(seed: int, gain: float = 1.0, noise: float = 4.0, first: int = 0) -> Episode:
    """A still scene of gray levels 60 to 160 with noise, both multiplied by the camera's gain from a step on."""
    scene = np.random.default_rng(0).uniform(60.0, 160.0, (12, 12))
    images = scene + np.random.default_rng(seed).normal(0.0, noise, (80, 12, 12))
    images[first:] *= gain
    return Episode(TASK, np.zeros((80, 2)), observations={"image": images.clip(0, 255).round().astype(np.uint8)})


def test_a_gain_of_the_camera_is_no_noise() -> None:
    reference = sensor_record([film(seed) for seed in range(5)]).reference

    def of(episode: Episode) -> dict[str, float]:
        return image_statistics(episode, "image", reference) | window_statistics(episode, reference)

    films = film(9), film(9, gain=1.5), film(9, gain=1.5, first=30), film(9, noise=6.0)
    healthy, bright, late, noisy = map(of, films)
    for name in ("noise/image/all", "noise/image/extreme"):
        assert bright[name] == pytest.approx(healthy[name], rel=0.05)
        assert noisy[name] == pytest.approx(1.5 * healthy[name], rel=0.1)
    assert late["noise/image/extreme"] == pytest.approx(healthy["noise/image/extreme"], rel=0.1)
    assert bright["brightness/image/all"] == pytest.approx(1.5, rel=0.02)
    assert noisy["brightness/image/all"] == pytest.approx(1.0, rel=0.02)
    assert healthy["clipped/image/all"] == 0.0
    assert of(film(9, gain=2.0))["clipped/image/all"] == pytest.approx(0.3, abs=0.1)  # of levels from 128


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_dark_images_with_noise_are_black_and_change_no_exposure(share: float) -> None:
    reference = sensor_record([film(seed) for seed in range(5)]).reference
    dark, rng = film(9), np.random.default_rng(1)
    count = round(share * len(dark))
    dark.observations["image"][:count] = rng.normal(0.0, 6.0, (count, 12, 12)).clip(0, 255).round()
    values = image_statistics(dark, "image", reference) | window_statistics(dark, reference)
    assert values["black/image/all"] == pytest.approx(share, abs=0.01)
    assert values["brightness/image/all"] == pytest.approx(1.0, rel=0.02)
    assert values["brightness/image/range"] == pytest.approx(1.0, rel=0.05)
    underexposed = image_statistics(film(9, gain=0.1), "image", reference)
    assert underexposed["brightness/image/all"] == pytest.approx(0.1, rel=0.1)
    assert underexposed["black/image/all"] == 0.0

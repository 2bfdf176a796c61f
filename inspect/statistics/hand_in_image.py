"""Where the hand is seen in images: a correlation filter, and the camera's map from measured positions to pixels.

The filter's response moves with the hand by the same number of pixels, whatever else is visible. So the distance of its
peak from the pixel of the measured position shows a moved camera or a wrong hand position without ground truth.
Bolme et al., "Visual object tracking using adaptive correlation filters" (CVPR 2010), with an unknown camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.statistics.signals import Array

RADIUS = 7
"""Pixels: half the width of the kernel. The response is searched up to ``SEARCH`` pixels from the expected pixel."""
SEARCH = 8

ITERATIONS = 6
"""Number of alternations between the camera's map and the filter."""

WIDTH = 1.0
"""Pixels: standard deviation of the response to the hand."""

RIDGE = 1.0
"""Regularisation of the filter, relative to the mean power of the images."""

BRIGHT = 0.95
"""Quantile of the squared contrast from which pixels are taken for the hand at first."""

FRAMES, PIXELS = 2000, 4_000_000
"""Maximum number of images to which the filter is fitted, and of their pixels, for the memory of large ones."""

MIN_SIDE = 8
"""Pixels: smallest side of images in which a hand is sought."""

MIN_FRAMES = 4
"""Minimum number of images with the hand inside."""

DIGITS = 4
"""Significant digits of stored values."""


@dataclass(frozen=True)
class HandFilter:
    """Localises the hand in images.

    Attributes:
        background: (H, W) mean of the normalised images.
        kernel: (2 RADIUS + 1, 2 RADIUS + 1) of the convolution with their difference; its response peaks at the hand.
        camera: (F, 2) x and y pixels as a quadratic polynomial of the hand position.
        scale: (2, d) m: mean and standard deviation of the hand position.
    """

    background: Array
    kernel: Array
    camera: Array
    scale: Array

    def to_json(self) -> dict[str, Any]:
        """JSON values, rounded to ``DIGITS``."""
        return {name: _rounded(values) for name, values in vars(self).items()}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> HandFilter:
        """Inverse of ``to_json``. Raises ValueError for arrays of wrong sizes."""
        background, kernel, camera, scale = (
            np.array(value[name], dtype=np.float64) for name in ("background", "kernel", "camera", "scale")
        )
        if background.ndim != 2 or kernel.shape != (2 * RADIUS + 1,) * 2 or camera.shape[1:] != (2,):
            raise ValueError(f"background {background.shape}, kernel {kernel.shape}, camera {camera.shape}")
        return cls(background, kernel, camera, scale)

    def pixels(self, hand: Array) -> Array:
        """(T, 2): x and y pixels at which the hand is expected for measured positions (T, d), m."""
        return quadratic((hand - self.scale[0]) / self.scale[1]) @ self.camera

    def offset(self, images: Array, hand: Array) -> Array:
        """(2,) pixels in x and y from the expected to the seen hand, pooled over normalised images (T, H, W).

        It is the peak of the mean response around the expected pixels; NaN if the hand is not inside of the images.
        """
        expected = self.pixels(hand)
        size = np.array(images.shape[:0:-1])
        inside = ((expected > 0.0) & (expected < size - 1.0)).all(axis=1)
        if inside.sum() < MIN_FRAMES:
            return np.full(2, np.nan)
        return _peaks(_around(self._response(images[inside]), expected[inside]).mean(axis=0)[None])[0] - SEARCH

    def _response(self, images: Array) -> Array:
        """(T, H, W): convolution of the images without the background, which is zero around them."""
        contrasts = images - self.background
        height, width = contrasts.shape[1:]
        shape = (height + 2 * RADIUS, width + 2 * RADIUS)
        full = np.fft.irfft2(np.fft.rfft2(contrasts, shape) * np.fft.rfft2(self.kernel, shape), shape)
        return full[:, RADIUS : RADIUS + height, RADIUS : RADIUS + width]


def fit_hand_filter(images: Array, hand: Array) -> HandFilter | None:
    """Fit the filter to normalised images (T, H, W) and hand positions (T, d), m.

    The pixel of the hand is unknown: it begins as the centre of the largest contrasts. In turn, the camera's map is
    fitted to the pixels, the filter to the map, and the pixels are the peaks of its response near those of the map.
    None for images that are too small, and so large that less than ``MIN_FRAMES`` are within ``PIXELS``.
    """
    frames = min(FRAMES, PIXELS // max(images[0].size, 1))
    if min(images.shape[1:]) < MIN_SIDE or min(frames, len(images)) < MIN_FRAMES:
        return None
    if len(images) > frames:
        chosen = np.linspace(0, len(images) - 1, frames).astype(int)
        images, hand = images[chosen], hand[chosen]
    background = images.mean(0)
    contrasts = images - background
    scale = np.stack([hand.mean(0), np.maximum(hand.std(0), 1e-6)])
    terms = quadratic((hand - scale[0]) / scale[1])
    height, width = contrasts.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    power = np.square(contrasts)
    power *= power >= np.quantile(power, BRIGHT, axis=(1, 2), keepdims=True)
    power /= np.maximum(power.sum((1, 2), keepdims=True), 1e-12)
    seen = np.stack([(power * columns).sum((1, 2)), (power * rows).sum((1, 2))], axis=1)
    shape = (height + 2 * RADIUS, width + 2 * RADIUS)
    spectrum = np.fft.rfft2(contrasts, shape)
    density = np.square(np.abs(spectrum)).mean(0)
    density += RIDGE * density.mean()
    for _ in range(ITERATIONS):
        camera = _robust_fit(terms, seen)
        x, y = (terms @ camera).T[:, :, None, None]
        target = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2.0 * WIDTH**2))
        cross = (np.fft.rfft2(target, shape) * np.conj(spectrum)).mean(0)
        full = np.roll(np.fft.irfft2(cross / density, shape), (RADIUS, RADIUS), axis=(0, 1))
        result = HandFilter(background, full[: 2 * RADIUS + 1, : 2 * RADIUS + 1], camera, scale)
        near = (np.abs(columns - x) <= SEARCH) & (np.abs(rows - y) <= SEARCH)
        seen = _peaks(np.where(near, result._response(images), -np.inf))
    return result


def quadratic(x: Array) -> Array:
    """(T, F): constant, linear and quadratic terms of x (T, d)."""
    i, j = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones((len(x), 1)), x, x[:, i] * x[:, j]], axis=1)


def _robust_fit(terms: Array, values: Array) -> Array:
    """(F, 2): least squares with Cauchy weights, in which outliers hardly count."""
    weights = np.ones(len(terms))
    for _ in range(3):
        root = np.sqrt(weights)[:, None]
        fit = np.asarray(np.linalg.lstsq(terms * root, values * root, rcond=None)[0], dtype=np.float64)
        distance = np.linalg.norm(values - terms @ fit, axis=1)
        weights = 1.0 / (1.0 + np.square(distance / (np.median(distance) + 0.3)))
    return fit


def _around(response: Array, centre: Array) -> Array:
    """(T, 2 SEARCH + 1, 2 SEARCH + 1): responses (T, H, W) around pixels (T, 2), interpolated linearly, 0 outside."""
    margin = SEARCH + 2
    padded = np.pad(response, ((0, 0), (margin, margin), (margin, margin)))
    corner = np.floor(centre).astype(int)
    fx, fy = (centre - corner).T[:, :, None, None]
    steps = np.arange(-SEARCH, SEARCH + 1) + margin
    t = np.arange(len(response))[:, None, None]
    i, j = corner[:, 1, None, None] + steps[:, None], corner[:, 0, None, None] + steps
    upper = (1.0 - fx) * padded[t, i, j] + fx * padded[t, i, j + 1]
    lower = (1.0 - fx) * padded[t, i + 1, j] + fx * padded[t, i + 1, j + 1]
    return np.asarray((1.0 - fy) * upper + fy * lower)


def _peaks(response: NDArray[np.float64]) -> Array:
    """(T, 2): x and y of the largest values of (T, H, W), refined by parabolas except at the border."""
    count, height, width = response.shape
    i, j = np.divmod(response.reshape(count, -1).argmax(1), width)
    t = np.arange(count)

    def vertex(before: Array, peak: Array, after: Array) -> Array:
        curvature = before - 2.0 * peak + after
        usable = np.isfinite(curvature) & (curvature < 0.0)
        return np.where(usable, 0.5 * (before - after) / np.where(usable, curvature, 1.0), 0.0)

    rows, columns = i.clip(1, height - 2), j.clip(1, width - 2)
    dy = vertex(*(response[t, rows + k, j] for k in (-1, 0, 1)))
    dx = vertex(*(response[t, i, columns + k] for k in (-1, 0, 1)))
    return np.stack([j + np.where(columns == j, dx, 0.0), i + np.where(rows == i, dy, 0.0)], axis=1)


def _rounded(values: Array) -> list[list[float]]:
    return [[float(f"{value:.{DIGITS}g}") for value in row] for row in values.tolist()]

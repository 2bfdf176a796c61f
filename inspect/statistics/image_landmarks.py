"""Where the hand or the object is seen in images: a correlation filter, and the camera's map from positions to pixels.

The filter's response moves with the landmark by the same number of pixels, whatever else is visible. So the distance of
its peak from the pixel of the measured or labelled position shows a moved camera or a wrong position, and its height
whether the landmark looks as it did, without any network of the filter under test.
Bolme et al., "Visual object tracking using adaptive correlation filters" (CVPR 2010), with an unknown camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from beliefscope.inspect.statistics.signals import Array, significant

RADIUS = 7
"""Pixels: half the width of the kernel. The response is searched up to ``SEARCH`` pixels from the expected pixel."""
SEARCH = 8

WIDTHS = (3.0, 2.5, 2.0, 1.7, 1.4, 1.2, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
"""Pixels: standard deviation of the response to the landmark in each alternation between the map and the filter."""

RIDGE = 0.02
"""Regularisation of the filter, relative to the mean power of the images."""

BRIGHT = 0.95
"""Quantile of the squared contrast from which pixels are taken for the landmark at first."""

FRAMES, PIXELS = 1500, 4_000_000
"""Maximum number of images to which the filter is fitted, and of their pixels, for the memory of large ones."""

MIN_SIDE = 8
"""Pixels: smallest side of images in which a landmark is sought."""

MIN_FRAMES = 4
"""Minimum number of images with the landmark inside."""

MAX_DISTANCE = 2.0
"""Pixels: largest median distance between the peaks of the response and the map of a landmark that is found."""

MIN_MATCH = 0.5
"""Smallest height of the response, relative to healthy images, whose peak is taken for the landmark."""

DIGITS, PIXEL_DIGITS = 4, 3
"""Significant digits of stored positions, and of stored gray levels and kernels."""


@dataclass(frozen=True)
class LandmarkFilter:
    """Localises a landmark in images.

    Attributes:
        background: (H, W) mean of the normalised images.
        kernel: (2 RADIUS + 1, 2 RADIUS + 1) of the convolution with their difference, which peaks at the landmark.
        camera: (F, 2) x and y pixels as a quadratic polynomial of the position.
        scale: (2, d) mean and standard deviation of the position.
        height: peak of the mean response in the images that it was fitted to; 0 in profiles of earlier versions.
    """

    background: Array
    kernel: Array
    camera: Array
    scale: Array
    height: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """JSON values, rounded to ``DIGITS`` and ``PIXEL_DIGITS``."""
        pixels = {"background": PIXEL_DIGITS, "kernel": PIXEL_DIGITS}
        return {f.name: significant(getattr(self, f.name), pixels.get(f.name, DIGITS)) for f in fields(self)}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> LandmarkFilter:
        """Inverse of ``to_json``. Raises ValueError for arrays of wrong sizes."""
        background, kernel, camera, scale = (
            np.array(value[name], dtype=np.float64) for name in ("background", "kernel", "camera", "scale")
        )
        if background.ndim != 2 or kernel.shape != (2 * RADIUS + 1,) * 2 or camera.shape[1:] != (2,):
            raise ValueError(f"background {background.shape}, kernel {kernel.shape}, camera {camera.shape}")
        return cls(background, kernel, camera, scale, float(value.get("height", 0.0)))

    def pixels(self, positions: Array) -> Array:
        """(T, 2): x and y pixels at which the landmark is expected for positions (T, d)."""
        return quadratic((positions - self.scale[0]) / self.scale[1]) @ self.camera

    def locate(self, images: Array, positions: Array) -> tuple[Array, float]:
        """Where the landmark is seen in normalised images (T, H, W), pooled over them.

        Returns (2,) pixels in x and y from the expected to the seen landmark, the peak of the mean response around the
        expected pixels, and the height of the peak relative to healthy images. Both are NaN if the landmark is not
        inside of the images, the former also if the height is below ``MIN_MATCH``.
        """
        expected = self.pixels(positions)
        inside = _inside(expected, images.shape)
        if inside.sum() < MIN_FRAMES:
            return np.full(2, np.nan), np.nan
        response = _around(self._response(images[inside]), expected[inside]).mean(axis=0)
        if self.height <= 0.0:
            return _peaks(response[None])[0] - SEARCH, np.nan
        match = float(max(response.max(), 0.0) / self.height)
        return (_peaks(response[None])[0] - SEARCH if match >= MIN_MATCH else np.full(2, np.nan)), match

    def _response(self, images: Array) -> NDArray[np.float32]:
        """(T, H, W): convolution of the images without the background, which is zero around them.

        In single precision, in which transforms take half the time and peaks have the same pixel to 1e-3.
        """
        contrasts = (images - self.background).astype(np.float32)
        shape = tuple(fft.next_fast_len(n + 2 * RADIUS, real=True) for n in images.shape[1:])
        return _convolution(fft.rfft2(contrasts, shape), self.kernel.astype(np.float32), images.shape[1:], shape)


def fit_landmark_filter(images: Array, positions: Array, others: Array | None = None) -> LandmarkFilter | None:
    """Fit the filter to normalised images (T, H, W) and positions (T, d) of the landmark.

    Its pixel is unknown: it begins as the centre of the largest contrasts, or of the part that the positions explain
    beyond the ``others`` (T, e), the positions of whatever else moves. In turn, the camera's map is fitted to the
    pixels, the filter to the map, and the pixels are the peaks of its response near those of the map; images in which
    these differ count less, because the landmark may be hidden. None for images that are too small, and so large that
    less than ``MIN_FRAMES`` are within ``PIXELS``, and if nothing in the images moves with the positions.
    """
    frames = min(FRAMES, PIXELS // max(images[0].size, 1))
    if min(images.shape[1:]) < MIN_SIDE or min(frames, len(images)) < MIN_FRAMES:
        return None
    if len(images) > frames:
        chosen = np.linspace(0, len(images) - 1, frames).astype(int)
        images, positions = images[chosen], positions[chosen]
        others = None if others is None else others[chosen]
    background = images.mean(0)
    contrasts = images - background
    scale, terms = _terms(positions)
    height, width = contrasts.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    power = np.square(contrasts if others is None else _explained(contrasts, terms, _terms(others)[1]))
    power *= power >= np.quantile(power, BRIGHT, axis=(1, 2), keepdims=True)
    power /= np.maximum(power.sum((1, 2), keepdims=True), 1e-12)
    seen = np.stack([(power * columns).sum((1, 2)), (power * rows).sum((1, 2))], axis=1)
    shape = (height + 2 * RADIUS, width + 2 * RADIUS)
    spectrum = fft.rfft2(contrasts.astype(np.float32), shape)  # see ``LandmarkFilter._response``
    conjugate = spectrum.conj()
    density = (spectrum.real**2 + spectrum.imag**2).mean(0, dtype=np.float64)
    density += RIDGE * density.mean()
    for size in WIDTHS:
        camera, weights = _robust_fit(terms, seen)
        x, y = (terms @ camera).T[:, :, None, None]
        # The target, a Gaussian at the landmark, is a product of its parts along y and x, and so is its spectrum.
        along_y = fft.fft(np.exp(-((np.arange(height) - y[:, 0]) ** 2) / (2.0 * size**2)) * weights[:, None], shape[0])
        along_x = fft.rfft(np.exp(-((np.arange(width) - x[:, 0]) ** 2) / (2.0 * size**2)), shape[1])
        parts = (part.astype(np.complex64) for part in (along_y, along_x))
        cross = np.einsum("ti,tj,tij->ij", *parts, conjugate, optimize=True) / weights.sum()
        full = np.roll(fft.irfft2(cross / density, shape), (RADIUS, RADIUS), axis=(0, 1))
        result = LandmarkFilter(background, full[: 2 * RADIUS + 1, : 2 * RADIUS + 1], camera, scale)
        near = (np.abs(columns[:1] - x) <= SEARCH) & (np.abs(rows[:, :1] - y) <= SEARCH)
        response = _convolution(spectrum, result.kernel.astype(np.float32), (height, width), shape)
        seen = _peaks(np.where(near, response, -np.inf))
    expected = terms @ camera
    inside = _inside(expected, response.shape)
    if inside.sum() < MIN_FRAMES or np.median(np.linalg.norm(seen - expected, axis=1)) > MAX_DISTANCE:
        return None
    return replace(result, height=float(_around(response[inside], expected[inside]).mean(axis=0).max()))


def _convolution(
    spectrum: NDArray[Any], kernel: NDArray[Any], size: tuple[int, ...], shape: tuple[int, ...]
) -> NDArray[Any]:
    """(T, H, W): convolution of contrasts of this size (H, W) with a kernel.

    Args:
        spectrum: Fourier transform of the contrasts, with zeros around the images to this shape.
    """
    height, width = size
    full = fft.irfft2(spectrum * fft.rfft2(kernel, shape), shape)
    return np.asarray(full[:, RADIUS : RADIUS + height, RADIUS : RADIUS + width])


def _terms(values: Array) -> tuple[Array, Array]:
    """(2, d) mean and standard deviation of values (T, d), and (T, F) the quadratic terms of the standardised ones."""
    scale = np.stack([values.mean(0), np.maximum(values.std(0), 1e-6)])
    return scale, quadratic((values - scale[0]) / scale[1])


def _explained(contrasts: Array, terms: Array, others: Array) -> Array:
    """(T, H, W): part of the contrasts that terms (T, F) explain linearly beyond the others (T, G)."""
    beyond = terms - others @ np.linalg.lstsq(others, terms, rcond=None)[0]
    flat = contrasts.reshape(len(contrasts), -1)
    return np.asarray((beyond @ np.linalg.lstsq(beyond, flat, rcond=None)[0]).reshape(contrasts.shape))


def quadratic(x: Array) -> Array:
    """(T, F): constant, linear and quadratic terms of x (T, d)."""
    i, j = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones((len(x), 1)), x, x[:, i] * x[:, j]], axis=1)


def _robust_fit(terms: Array, values: Array) -> tuple[Array, Array]:
    """(F, 2): least squares with Cauchy weights (T,), in which outliers hardly count; also returns these."""
    weights = np.ones(len(terms))
    for _ in range(3):
        root = np.sqrt(weights)[:, None]
        fit = np.asarray(np.linalg.lstsq(terms * root, values * root, rcond=None)[0], dtype=np.float64)
        distance = np.linalg.norm(values - terms @ fit, axis=1)
        weights = 1.0 / (1.0 + np.square(distance / (np.median(distance) + 0.3)))
    return fit, weights


def _inside(pixels: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(T,): whether pixels (T, 2), x and y, are inside of images of this shape (T, H, W)."""
    return np.asarray(((pixels > 0.0) & (pixels < np.array(shape[:0:-1]) - 1.0)).all(axis=1))


def _around(response: NDArray[Any], centre: Array) -> Array:
    """(T, 2 SEARCH + 1, 2 SEARCH + 1): responses (T, H, W) around pixels (T, 2) inside, interpolated linearly."""
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
        with np.errstate(invalid="ignore"):  # at the border of the searched pixels, the others are -inf
            curvature = before - 2.0 * peak + after
            usable = np.isfinite(curvature) & (curvature < 0.0)
            return np.where(usable, 0.5 * (before - after) / np.where(usable, curvature, 1.0), 0.0)

    rows, columns = i.clip(1, height - 2), j.clip(1, width - 2)
    dy = vertex(*(response[t, rows + k, j] for k in (-1, 0, 1)))
    dx = vertex(*(response[t, i, columns + k] for k in (-1, 0, 1)))
    return np.stack([j + np.where(columns == j, dx, 0.0), i + np.where(rows == i, dy, 0.0)], axis=1)

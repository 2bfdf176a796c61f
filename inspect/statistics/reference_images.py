"""Healthy reference of the images of a task: the median image, the image expected for a hand position, and its inverse.

A healthy profile stores it, so that the images of later episodes can be compared with it without ground truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode, lost_images
from beliefscope.inspect.statistics.signals import Array

Gray = NDArray[np.uint8]

HAND = "effector_position"
"""Observation key of the measured hand position."""

DIGITS = 3
"""Significant digits of stored weights."""

LEVELS = 127
"""Largest integer of stored expected images."""

TAIL = 0.002
"""Share of the images below and above the range of a pixel."""

RIDGE = 100.0
"""Penalty of the weights, relative to images of unit variance."""


@dataclass(frozen=True)
class Reference:
    """Healthy values of one image sensor.

    Attributes:
        key: observation key of the images.
        image: (H, W) median over episodes of their median images. spread: (H, W) largest difference of an episode's.
        weights: (1 + H W, d) of the regression of the hand position on an image, normalised to zero mean and unit
            variance; row 0 is the constant. Empty (0, 0) for data without hand positions.
        expected: (F, H, W) coefficients of the normalised image as a quadratic polynomial of the hand position.
        scale: (2, d) m: mean and standard deviation of the hand position.
        range: (2, H, W) nearly smallest and largest gray level of the images, corrected for the exposure of their
            episode; None in profiles of earlier versions.
    """

    key: str
    image: Gray
    spread: Gray
    weights: Array
    expected: Array
    scale: Array
    range: Gray | None = None

    def to_json(self) -> dict[str, Any]:
        """JSON values; weights rounded to ``DIGITS``."""
        size = np.maximum(np.abs(self.expected).max(axis=(1, 2)), 1e-9) / LEVELS  # (F,)
        levels = np.rint(self.expected / size[:, None, None]).astype(int)
        return {
            "key": self.key,
            "image": self.image.tolist(),
            "spread": self.spread.tolist(),
            "weights": _rounded(self.weights.T),
            "expected": {"size": size.tolist(), "levels": levels.reshape(len(levels), self.image.size).tolist()},
            "scale": self.scale.tolist(),
            "range": None if self.range is None else self.range.tolist(),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Reference:
        """Inverse of ``to_json``. Raises ValueError for arrays of different sizes."""
        image, spread = (np.array(value[name], dtype=np.uint8) for name in ("image", "spread"))
        weights = np.array(value["weights"], dtype=np.float64).T
        size = np.array(value["expected"]["size"], dtype=np.float64)
        levels = np.array(value["expected"]["levels"], dtype=np.float64).reshape(len(size), *image.shape)
        scale = np.array(value["scale"], dtype=np.float64)
        range_ = None if value.get("range") is None else np.array(value["range"], dtype=np.uint8)
        if image.ndim != 2 or spread.shape != image.shape or len(weights) not in (0, 1 + image.size):
            raise ValueError(f"image {image.shape}, spread {spread.shape}, weights {weights.shape}")
        if range_ is not None and range_.shape != (2, *image.shape):
            raise ValueError(f"image {image.shape}, range {range_.shape}")
        return cls(str(value["key"]), image, spread, weights, levels * size[:, None, None], scale, range_)

    @property
    def has_hand(self) -> bool:
        """Whether the data have hand positions."""
        return bool(self.weights.size)

    def hand(self, images: Gray) -> Array:
        """(T, d) m: the hand position seen in images (T, H, W)."""
        return self.weights[0] + normalised(images) @ self.weights[1:]

    def images(self, hand: Array) -> Array:
        """(T, H, W): the normalised images expected for hand positions (T, d), m."""
        return np.tensordot(_polynomial((hand - self.scale[0]) / self.scale[1]), self.expected, axes=1)


def image_keys(episode: Episode) -> list[str]:
    """Observation keys of grey images (T, H, W)."""
    return [key for key, array in episode.observations.items() if array.ndim == 3 and array.dtype == np.uint8]


def median_image(images: Gray) -> Array:
    """(H, W) median over the steps with an image; NaN without any."""
    seen = images[~lost_images(images)]
    return np.median(seen, axis=0) if len(seen) else np.full(images.shape[1:], np.nan)


def measure_reference(episodes: Sequence[Episode]) -> Reference | None:
    """The reference of clean episodes; None for tasks without an image."""
    if not episodes or not (keys := image_keys(episodes[0])):
        return None
    key = keys[0]
    medians = np.stack([median_image(episode.observations[key]) for episode in episodes])
    image = np.nanmedian(medians, axis=0)
    spread = np.nanmax(np.abs(medians - image), axis=0)
    gray, spread = (np.rint(values).clip(0, 255).astype(np.uint8) for values in (image, np.ceil(spread)))
    return Reference(key, gray, spread, *_hand_camera(episodes, key), _gray_range(episodes, key, medians, image))


def _gray_range(episodes: Sequence[Episode], key: str, medians: Array, image: Array) -> Gray:
    """``range`` of a reference. The exposure of an episode is the median ratio of its median image to ``image``."""
    bright = image > 0
    seen = []
    for episode, middle in zip(episodes, medians, strict=True):
        if np.isfinite(middle).all():
            images = episode.observations[key]
            ratio = max(float(np.median(middle[bright] / image[bright])), 1e-3)
            seen.append(images[~lost_images(images)] / np.float32(ratio))
    result = np.quantile(np.concatenate(seen), [TAIL, 1.0 - TAIL], axis=0)
    return np.rint(result).clip(0, 255).astype(np.uint8)


def _hand_camera(episodes: Sequence[Episode], key: str) -> tuple[Array, Array, Array]:
    """``weights``, ``expected`` and ``scale`` of a reference, from the steps with an image.

    Ridge regression of the hand position on the image, and least squares of the image on polynomials of the position.
    """
    if HAND not in episodes[0].observations:
        return np.zeros((0, 0)), np.zeros((0, *episodes[0].observations[key].shape[1:])), np.zeros((2, 0))
    seen = [~lost_images(episode.observations[key]) for episode in episodes]
    pairs = list(zip(episodes, seen, strict=True))
    images = np.concatenate([normalised(episode.observations[key][at]) for episode, at in pairs])
    hand = np.concatenate([episode.observations[HAND][at] for episode, at in pairs]).astype(np.float64)
    image_mean, hand_mean = images.mean(0), hand.mean(0)
    centred = images - image_mean
    gram = centred.T @ centred + RIDGE * np.eye(images.shape[1])
    weights = np.linalg.solve(gram, centred.T @ (hand - hand_mean))
    weights = np.concatenate([(hand_mean - image_mean @ weights)[None], weights])
    scale = np.stack([hand_mean, np.maximum(hand.std(0), 1e-6)])
    expected = np.linalg.lstsq(_polynomial((hand - scale[0]) / scale[1]), images, rcond=None)[0]
    return weights, expected.reshape(-1, *episodes[0].observations[key].shape[1:]), scale


def _polynomial(x: Array) -> Array:
    """(T, F): constant, linear and quadratic terms of x (T, d)."""
    i, j = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones((len(x), 1)), x, x[:, i] * x[:, j]], axis=1)


def _rounded(values: Array) -> list[list[float]]:
    return [[float(f"{value:.{DIGITS}g}") for value in row] for row in values.tolist()]


def normalised(images: Gray) -> Array:
    """(T, H W): images with zero mean and unit variance, so that exposure does not matter."""
    values = images.reshape(len(images), -1).astype(np.float64)
    values -= values.mean(1, keepdims=True)
    return values / np.maximum(values.std(1, keepdims=True), 1e-9)

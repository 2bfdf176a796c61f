"""Healthy reference of the episodes of a task: the median image, the image expected for a hand position, landmarks, and
the distance of the hand from the object in contact.

A healthy profile stores it, so that the images of later episodes can be compared with it without ground truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from beliefscope.datasets.episode import Episode, lost_images
from beliefscope.inspect.statistics.contact_distance import HARMONICS, fit_contact_distance
from beliefscope.inspect.statistics.image_landmarks import DIGITS, LandmarkFilter, fit_landmark_filter, quadratic
from beliefscope.inspect.statistics.signals import Array, significant

Gray = NDArray[np.uint8]
Spectrum = NDArray[np.complex128]

HAND = "effector_position"
"""Observation key of the measured hand position."""

CONTACT = "contact"
"""Observation key of the contact flag."""

LEVELS = 127
"""Largest integer of stored expected images."""

LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue."""

TAIL = 0.002
"""Share of the images below and above the range of a pixel."""


@dataclass(frozen=True)
class Reference:
    """Healthy values of one image sensor, and of the hand against the labelled object.

    Attributes:
        key: observation key of the images.
        image: (H, W) median over episodes of their median images. spread: (H, W) largest difference of an episode's.
        expected: (F, H, W) coefficients of the image, normalised to zero mean and unit variance, as a quadratic
            polynomial of the hand position.
        scale: (2, d) m: mean and standard deviation of the hand position; (2, 0) for data without it.
        range: (2, H, W) nearly smallest and largest gray level of the images, corrected for the exposure of their
            episode; None in profiles of earlier versions.
        hand: where the hand is seen; None for data without hand positions and in profiles of earlier versions.
        object: where the object is seen, from the labels of the map's components; None for data without labels, and
            in profiles of earlier versions.
        contact: (2 HARMONICS + 1,) m: distance of the hand from the object in contact by direction
            (``contact_distance.py``); None for data without contact, and in profiles of earlier versions.
    """

    key: str
    image: Gray
    spread: Gray
    expected: Array
    scale: Array
    range: Gray | None = None
    hand: LandmarkFilter | None = None
    object: LandmarkFilter | None = None
    contact: Array | None = None

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        size = np.maximum(np.abs(self.expected).max(axis=(1, 2)), 1e-9) / LEVELS  # (F,)
        levels = np.rint(self.expected / size[:, None, None]).astype(int)
        return {
            "key": self.key,
            "image": self.image.tolist(),
            "spread": self.spread.tolist(),
            "expected": {"size": size.tolist(), "levels": levels.reshape(len(levels), self.image.size).tolist()},
            "scale": self.scale.tolist(),
            "range": None if self.range is None else self.range.tolist(),
            "hand": None if self.hand is None else self.hand.to_json(),
            "object": None if self.object is None else self.object.to_json(),
            "contact": None if self.contact is None else significant(self.contact, DIGITS),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Reference:
        """Inverse of ``to_json``. Raises ValueError for arrays of different sizes."""
        image, spread = (np.array(value[name], dtype=np.uint8) for name in ("image", "spread"))
        size = np.array(value["expected"]["size"], dtype=np.float64)
        levels = np.array(value["expected"]["levels"], dtype=np.float64).reshape(len(size), *image.shape)
        scale = np.array(value["scale"], dtype=np.float64)
        range_ = None if value.get("range") is None else np.array(value["range"], dtype=np.uint8)
        hand, object_ = (
            None if value.get(name) is None else LandmarkFilter.from_json(value[name]) for name in ("hand", "object")
        )
        if image.ndim != 2 or spread.shape != image.shape:
            raise ValueError(f"image {image.shape}, spread {spread.shape}")
        if range_ is not None and range_.shape != (2, *image.shape):
            raise ValueError(f"image {image.shape}, range {range_.shape}")
        contact = None if value.get("contact") is None else np.array(value["contact"], dtype=np.float64)
        if contact is not None and contact.shape != (2 * HARMONICS + 1,):
            raise ValueError(f"contact {contact.shape}")
        return cls(
            str(value["key"]), image, spread, levels * size[:, None, None], scale, range_, hand, object_, contact
        )

    @property
    def has_hand(self) -> bool:
        """Whether the data have hand positions."""
        return bool(self.scale.size)

    def terms(self, hand: Array) -> Array:
        """(T, F): factors of ``expected`` whose sum is the image expected for hand positions (T, d), m."""
        return quadratic((hand - self.scale[0]) / self.scale[1])

    @cached_property
    def gradients(self) -> tuple[Spectrum, Spectrum]:
        """Vertical and horizontal ``gradients`` of ``expected``."""
        return gradients(self.expected)


def gradients(images: Array) -> tuple[Spectrum, Spectrum]:
    """Fourier transforms (N, 2 H, W + 1) of the vertical and horizontal gradients of images (N, H, W), zero around."""
    shape = (2 * images.shape[1], 2 * images.shape[2])
    vertical, horizontal = (fft.rfft2(np.gradient(images, axis=axis), shape) for axis in (1, 2))
    return vertical, horizontal


def image_keys(episode: Episode) -> list[str]:
    """Observation keys of gray images (T, H, W)."""
    return [key for key, array in episode.observations.items() if array.ndim == 3 and array.dtype == np.uint8]


def with_gray_images(episode: Episode) -> Episode:
    """The episode with images of colours (T, H, W, 3) as the gray ones (T, H, W) of their luminance (Rec. 601)."""
    keys = [key for key, array in episode.observations.items() if array.ndim == 4 and array.dtype == np.uint8]
    if not keys:
        return episode
    gray = {key: np.rint(episode.observations[key] @ LUMINANCE).astype(np.uint8) for key in keys}
    return replace(episode, observations={**episode.observations, **gray})


def median_image(images: Gray) -> Array:
    """(H, W) median over the steps with an image; NaN without any."""
    seen = images[~lost_images(images)]
    return np.median(seen, axis=0) if len(seen) else np.full(images.shape[1:], np.nan)


def measure_reference(episodes: Sequence[Episode]) -> Reference | None:
    """The reference of clean episodes; None for tasks without an image."""
    episodes = [with_gray_images(episode) for episode in episodes]
    if not episodes or not (keys := image_keys(episodes[0])):
        return None
    key = keys[0]
    medians = np.stack([median_image(episode.observations[key]) for episode in episodes])
    image = np.nanmedian(medians, axis=0)
    spread = np.nanmax(np.abs(medians - image), axis=0)
    gray, spread = (np.rint(values).clip(0, 255).astype(np.uint8) for values in (image, np.ceil(spread)))
    expected, scale, hand = _hand_camera(episodes, key)
    range_, object_ = _gray_range(episodes, key, medians, image), _object_filter(episodes, key)
    touching = [moved for episode in episodes if (moved := displacements_in_contact(episode)) is not None]
    contact = fit_contact_distance(touching)
    return Reference(key, gray, spread, expected, scale, range_, hand, object_, contact)


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


def _hand_camera(episodes: Sequence[Episode], key: str) -> tuple[Array, Array, LandmarkFilter | None]:
    """``expected``, ``scale`` and ``hand`` of a reference, from the steps with an image."""
    size = episodes[0].observations[key].shape[1:]
    if HAND not in episodes[0].observations:
        return np.zeros((0, *size)), np.zeros((2, 0)), None
    seen = [~lost_images(episode.observations[key]) for episode in episodes]
    pairs = list(zip(episodes, seen, strict=True))
    images = np.concatenate([normalised(episode.observations[key][at]) for episode, at in pairs])
    hand = np.concatenate([episode.observations[HAND][at] for episode, at in pairs]).astype(np.float64)
    scale = np.stack([hand.mean(0), np.maximum(hand.std(0), 1e-6)])
    expected = np.linalg.lstsq(quadratic((hand - scale[0]) / scale[1]), images.reshape(len(images), -1), rcond=None)[0]
    return expected.reshape(-1, *size), scale, fit_landmark_filter(images, hand)


def _object_filter(episodes: Sequence[Episode], key: str) -> LandmarkFilter | None:
    """``object`` of a reference, from the steps with an image of labelled episodes."""
    parts = []
    for episode in episodes:
        if (positions := object_positions(episode)) is not None:
            seen = ~lost_images(episode.observations[key])
            parts.append((normalised(episode.observations[key][seen]), positions[seen], _others(episode)[seen]))
    return fit_landmark_filter(*map(np.concatenate, zip(*parts, strict=True))) if parts else None


def _others(episode: Episode) -> Array:
    """(T, e): what moves in the images beside the object's position: the hand, and the other components of the state.

    Of angles these are cosine and sine.
    """
    columns = [np.ones((len(episode), 1))]
    if HAND in episode.observations:
        columns.append(episode.observations[HAND].astype(np.float64))
    for i, component in enumerate(episode.task.components):
        if i not in episode.task.map_indices:
            values = episode.states[:, [i]].astype(np.float64)
            columns += [np.cos(values), np.sin(values)] if component.unit == "rad" else [values]
    return np.concatenate(columns, axis=1)


def object_positions(episode: Episode) -> Array | None:
    """(T, d): true values of the components of the likelihood map; None without labels or map components."""
    positions = episode.states[:, list(episode.task.map_indices)].astype(np.float64)
    return positions if positions.size and np.isfinite(positions).all() else None


def displacements_in_contact(episode: Episode) -> Array | None:
    """(C, 2) m: from the labelled object to the measured hand in the horizontal plane, at the steps in contact.

    None for data without one of them, and if the object's position has not two components.
    """
    positions = object_positions(episode)
    if positions is None or positions.shape[1] != 2 or not {HAND, CONTACT} <= episode.observations.keys():
        return None
    hand = episode.observations[HAND].astype(np.float64)
    touching = episode.observations[CONTACT][:, 0] > 0.5
    return np.asarray((hand[:, :2] - positions)[touching]) if hand.shape[1] >= 2 else None


def normalised(images: Gray) -> Array:
    """(T, H, W): images with zero mean and unit variance, so that exposure does not matter."""
    values = images.astype(np.float64)
    values -= values.mean((1, 2), keepdims=True)
    return values / np.maximum(values.std((1, 2), keepdims=True), 1e-9)

"""Statistics of images without ground truth: lost, frozen, exposure, noise, sharpness, shift, occlusion and delay."""

from __future__ import annotations

import numpy as np
from scipy import fft

from beliefscope.datasets.episode import Episode, lost_images
from beliefscope.inspect.statistics.image_landmarks import LandmarkFilter
from beliefscope.inspect.statistics.reference_images import (
    HAND,
    Gray,
    Reference,
    gradients,
    median_image,
    normalised,
    object_positions,
)
from beliefscope.inspect.statistics.signals import MIN_STEPS, Array, Mask, lag, noise_level, repeats

BLACK = 8
"""Gray level up to which a pixel carries no information about the exposure."""

UNLIT = 0.2
"""Largest exposure of an image without light: noise that is cut off at black looks like some."""

SEEN = 0.5
"""Smallest share of the images of a window that must be seen."""

SATURATED = 254.5
"""Gray level from which a pixel is saturated; levels of colours are rounded."""

DARK, BRIGHT = 30.0, 225.0
"""Gray levels between which noise is not clipped."""

TOLERANCE = 12.0
"""Gray levels by which a pixel must differ from all healthy images to count as occluded."""

MOTION_FLOOR = 1e-4
"""m per step added to the hand's speed, and gray levels to the image's, before the logarithm."""


def frozen_images(images: Gray, held: int = 0) -> Mask:
    """(T,): whether an image repeats the previous one; lost images do not count. held: as in ``repeats``."""
    return repeats(images, held) & ~lost_images(images)


def image_statistics(
    episode: Episode, key: str, reference: Reference | None, gain: float | None = None
) -> dict[str, float]:
    """Statistics of one image sensor in an episode or a window; some only with a reference of the same sensor and size.

    Steps without an image do not count. Dark images, which have noise but no light, count as black; a reference shows
    them.

    Args:
        gain: of a window, by which the noise of brighter images is divided. Default: their exposure.
    """
    images, present = episode.observations[key], episode.present(key)
    if not present.any():
        return {}
    lost, frozen = lost_images(images), frozen_images(images, episode.task.held_steps(key))
    lit = usable = present & ~lost
    comparable = reference if usable.any() and _is_comparable(reference, key, images) else None
    if comparable is not None:
        lit = usable & (brightness_of(images, comparable) >= UNLIT)
        if gain is None and not lit.any():  # the images of an episode without light are underexposed
            lit = usable
    dark, middle = ~lit[present], median_image(images[lit])
    comparable = comparable if lit.any() and (gain is None or lit[present].mean() >= SEEN) else None
    brightness = 1.0 if comparable is None else float(brightness_of(middle, comparable))
    noise = _noise(images[lit & ~frozen_images(images)], brightness)
    values = {
        f"black/{key}/all": float(dark.mean()),
        f"losses/{key}/all": float((np.diff(dark, prepend=False) & dark).mean()),
        f"frozen/{key}/all": float(frozen[present].mean()),
        f"noise/{key}/all": noise / max(1.0, brightness if gain is None else gain),
        f"sharpness/{key}/all": _sharpness(middle),
        f"clipped/{key}/all": float((images[usable] >= SATURATED).mean()) if usable.any() else np.nan,
    }
    if comparable is None:
        return values
    values |= {
        f"brightness/{key}/all": brightness,
        f"occlusion/{key}/all": float(occluded_pixels(middle, brightness, comparable).mean()),
    }
    if comparable.has_hand and HAND in episode.observations and (both := lit & episode.present(HAND)).any():
        hand, seen = episode.observations[HAND].astype(np.float64)[both], normalised(images[both])
        shift = registration(comparable, hand, seen)
        values |= {f"shift/{key} {axis}/all": pixels for axis, pixels in zip("xy", shift, strict=True)}
        values |= _landmark("hand", key, comparable.hand, seen, hand)
    return values


def motion_statistics(episode: Episode, key: str, reference: Reference | None) -> dict[str, float]:
    """Statistics of one image sensor in an episode: its delay behind the hand, and where the object is seen."""
    images, present = episode.observations[key], episode.present(key)
    if not present.any():
        return {}
    values: dict[str, float] = {}
    if HAND in episode.observations:
        values[f"lag/{key}/all"] = image_lag(images, episode.observations[HAND], present)
    usable, positions = present & ~lost_images(images), object_positions(episode)
    if reference is None or positions is None or not usable.any() or not _is_comparable(reference, key, images):
        return values
    return values | _landmark("object", key, reference.object, normalised(images[usable]), positions[usable])


def _is_comparable(reference: Reference | None, key: str, images: Gray) -> bool:
    """Whether the reference is of images of this sensor and size."""
    return reference is not None and (reference.key, reference.image.shape) == (key, images.shape[1:])


def _landmark(
    name: str, key: str, landmark: LandmarkFilter | None, images: Array, positions: Array
) -> dict[str, float]:
    """Offset and match of a landmark with a name in normalised images (T, H, W); none without its filter."""
    if landmark is None:
        return {}
    offset, match = landmark.locate(images, positions)
    values = {f"{name} offset/{key} {axis}/all": float(pixels) for axis, pixels in zip("xy", offset, strict=True)}
    return values | {f"{name} match/{key}/all": match}


def is_usable(images: Gray, present: Mask, held: int = 0) -> bool:
    """Whether at least half of the images of a window are present, seen and not frozen. held: as in ``repeats``."""
    return bool((present & ~lost_images(images) & ~frozen_images(images, held)).mean() >= SEEN)


def occluded_share(images: Gray, key: str, reference: Reference | None) -> dict[str, float]:
    """Share of the pixels of a window's median image that are outside of the range of all healthy images."""
    middle = median_image(images)
    if reference is None or reference.range is None or not _is_comparable(reference, key, images):
        return {}
    low, high = reference.range.astype(np.float64)
    corrected = middle / max(float(brightness_of(middle, reference)), 1e-3)
    outside = (corrected < low - TOLERANCE) | (corrected > high + TOLERANCE)
    return {f"occlusion/{key}/all": float(outside.mean())}


def image_lag(images: Gray, hand: Array, present: Mask) -> float:
    """Steps by which images (T, H, W), at the steps ``present`` (T,), follow the measured hand (T, d); NaN if unknown.

    Cross-correlation of the logarithms of two speeds: the mean change of the pixels and that of the hand. The pixels'
    depends neither on the camera's position nor on what else is visible.
    """
    lost, frozen = lost_images(images), frozen_images(images)
    change = np.abs(np.diff(images.astype(np.float64), axis=0))
    level = noise_level(images[~lost].astype(np.float64)) if (~lost).sum() >= MIN_STEPS else np.zeros(images.shape[1:])
    pixels = np.maximum(change - 3.0 * level, 0.0).mean((1, 2))
    speed = np.linalg.norm(np.diff(hand.astype(np.float64), axis=0), axis=1)
    valid = present[1:] & present[:-1] & ~(lost[1:] | lost[:-1] | frozen[1:])
    late, early = np.log(pixels + 10.0 * MOTION_FLOOR), np.log(speed + MOTION_FLOOR)
    return lag(late[:, None], early[:, None], valid)[0]


def registration(reference: Reference, hand: Array, images: Array) -> tuple[float, float]:
    """(x, y) pixels by which normalised images (T, H, W) are shifted to the right and downwards.

    Maximum of the cross-correlation of horizontal and vertical gradients with those expected at hand positions (T, d),
    pooled over the images, over all shifts up to a quarter of an image, refined by a parabola. The expected images are
    sums of few images, so those are correlated, each with the sum of the images weighted alike.
    """
    height, width = images.shape[1:]
    rows, columns = height // 4, width // 4
    pooled = np.tensordot(reference.terms(hand), images, axes=(0, 0))
    spectrum = sum((a * np.conj(b)).sum(0) for a, b in zip(gradients(pooled), reference.gradients, strict=True))
    product = np.roll(fft.irfft2(spectrum, (2 * height, 2 * width)), (rows, columns), axis=(0, 1))
    power = product[: 2 * rows + 1, : 2 * columns + 1]
    i, j = (int(k) for k in np.unravel_index(int(power.argmax()), power.shape))
    return j - columns + _vertex(power[i], j), i - rows + _vertex(power[:, j], i)


def _vertex(values: Array, i: int) -> float:
    """Offset of the vertex of the parabola through values i - 1, i, i + 1 from i; zero at the border."""
    if not 0 < i < len(values) - 1:
        return 0.0
    a, b, c = values[i - 1 : i + 2]
    return float(0.5 * (a - c) / (a - 2.0 * b + c)) if a - 2.0 * b + c < 0 else 0.0


def occluded_pixels(middle: Array, brightness: float, reference: Reference) -> Mask:
    """(..., H, W): pixels of a median image outside of the healthy range, corrected for its exposure."""
    difference = np.abs(middle / max(brightness, 1e-3) - reference.image)
    return np.asarray(difference > reference.spread + TOLERANCE)


def brightness_of(images: Array, reference: Reference) -> Array:
    """(...,) exposure of images (..., H, W): the median ratio of pixels, which an occlusion does not change."""
    bright = reference.image > BLACK
    ratio = images[..., bright] / reference.image[bright]
    return np.asarray(np.median(ratio, axis=-1) if bright.any() else np.full(images.shape[:-2], np.nan))


def _noise(images: Gray, brightness: float) -> float:
    """Gray levels: median noise of the pixels between ``DARK`` and ``BRIGHT``, of darker images of the same pixels."""
    if len(images) < MIN_STEPS:
        return np.nan
    middle = np.median(images, axis=0)
    usable = (middle > DARK * min(brightness, 1.0)) & (middle < BRIGHT)
    level = noise_level(images.astype(np.float64))
    return float(np.median(level[usable] if usable.any() else level))


def _sharpness(middle: Array) -> float:
    """Standard deviation of the Laplacian of an image (H, W) relative to that of the image."""
    inner = middle[1:-1, 1:-1]
    laplacian = middle[:-2, 1:-1] + middle[2:, 1:-1] + middle[1:-1, :-2] + middle[1:-1, 2:] - 4.0 * inner
    return float(laplacian.std() / inner.std()) if np.isfinite(middle).all() and inner.std() > 0 else np.nan

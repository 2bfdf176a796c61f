"""Rotations in three dimensions: rotation vectors, unit quaternions (w, x, y, z), differences and means.

A rotation vector is the axis times the angle, rad, of the rotation from the body to the world, with an angle of at most
pi. A quaternion and its negative are the same rotation and have the same vector.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def to_vector(quaternion: NDArray[Any]) -> Array:
    """Rotation vectors (..., 3) of quaternions (..., 4) of any norm above 0: the logarithm of the rotation."""
    q = np.asarray(quaternion, dtype=np.float64)
    q = np.where(q[..., :1] < 0.0, -q, q)
    length = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    small = length < 1e-12 * np.abs(q[..., :1])
    scale = np.where(small, 2.0 / np.where(small, q[..., :1], 1.0), 0.0)
    scale = np.where(small, scale, 2.0 * np.arctan2(length, q[..., :1]) / np.where(length > 0.0, length, 1.0))
    return np.asarray(scale * q[..., 1:])


def to_quaternion(vector: NDArray[Any]) -> Array:
    """Unit quaternions (..., 4) of rotation vectors (..., 3): the exponential of the vector."""
    v = np.asarray(vector, dtype=np.float64)
    half = np.linalg.norm(v, axis=-1, keepdims=True) / 2.0
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) * v / 2.0], axis=-1)


def multiply(a: NDArray[Any], b: NDArray[Any]) -> Array:
    """Products (..., 4) of quaternions: rotation b, then a."""
    (w, x, y, z), (s, i, j, k) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    parts = (
        w * s - x * i - y * j - z * k,
        w * i + x * s + y * k - z * j,
        w * j - x * k + y * s + z * i,
        w * k + x * j - y * i + z * s,
    )
    return np.stack(parts, axis=-1)


def difference(a: NDArray[Any], b: NDArray[Any]) -> Array:
    """``log(R_b^-1 R_a)`` (..., 3) of rotation vectors a and b: rotation from b to a, in the body axes of b.

    It is left-invariant: another world frame leaves it unchanged. Sola, Deray and Atchuthan, "A micro Lie theory for
    state estimation in robotics", 2018, equation 26.
    """
    inverse = to_quaternion(b) * (1.0, -1.0, -1.0, -1.0)
    return to_vector(multiply(inverse, to_quaternion(a)))


def add(vector: NDArray[Any], offset: NDArray[Any]) -> Array:
    """``log(R exp(offset))`` (..., 3): the rotation vector for which ``difference`` from ``vector`` is ``offset``."""
    return to_vector(multiply(to_quaternion(vector), to_quaternion(offset)))


def mean(vectors: NDArray[Any], weights: NDArray[Any]) -> Array:
    """Mean (..., 3) of rotation vectors (..., M, 3) with normalised weights (..., M).

    The quaternion is the eigenvector of ``sum w q q^T`` with the largest eigenvalue, which does not depend on the signs
    of the quaternions. Markley, Cheng, Crassidis and Oshman, "Averaging quaternions", 2007.
    """
    q = to_quaternion(vectors)
    return to_vector(np.linalg.eigh(np.einsum("...m,...mi,...mj->...ij", weights, q, q))[1][..., -1])

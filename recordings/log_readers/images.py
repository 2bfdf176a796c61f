"""Images of logs as arrays: raw and compressed image messages."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput, unknown_name

RAW = {
    "mono8": ("u1", [0]),
    "8UC1": ("u1", [0]),
    "rgb8": ("u1", [0, 1, 2]),
    "8UC3": ("u1", [2, 1, 0]),
    "bgr8": ("u1", [2, 1, 0]),
    "rgba8": ("u1", [0, 1, 2, 3]),
    "bgra8": ("u1", [2, 1, 0, 3]),
    "mono16": ("u2", [0]),
    "16UC1": ("u2", [0]),
    "32FC1": ("f4", [0]),
}
"""Encoding of an image message -> type of its numbers, and its channels in the order red, green, blue."""


def is_image(fields: Mapping[str, Any]) -> bool:
    """Whether a message with the field ``data`` is an image, raw or compressed."""
    return {"height", "width", "encoding", "step"} <= fields.keys() or fields.keys() >= {"format", "data"}


def image_of(fields: Mapping[str, Any]) -> NDArray[Any]:
    """(H, W) or (H, W, 3) pixels of an image message.

    Raises BadInput for an encoding that is not in ``RAW`` and for fewer bytes than pixels.
    """
    data = fields["data"]  # JSON has no bytes: base64
    content = base64.b64decode(data) if isinstance(data, str) else bytes(data)
    if "encoding" not in fields:
        return decoded(content)
    height, width, row, encoding = (fields[name] for name in ("height", "width", "step", "encoding"))
    if encoding not in RAW:
        raise unknown_name("image encoding", str(encoding), RAW)
    kind, order = RAW[encoding]
    kind = (">" if fields.get("is_bigendian") else "<") + kind
    pixel = np.dtype(kind).itemsize * len(order)
    if not 0 < width * pixel <= row or not 0 < height * row <= len(content):
        raise BadInput(f"an image of {height} rows of {row} bytes has {len(content)} bytes and {width} pixels per row")
    rows = np.frombuffer(content, np.uint8, height * row).reshape(height, row)[:, : width * pixel]
    return channels(np.ascontiguousarray(rows).view(kind).reshape(height, width, len(order))[:, :, order])


def decoded(content: bytes) -> NDArray[np.uint8]:
    """(H, W) or (H, W, 3) pixels of a compressed image, such as PNG or JPEG. Raises BadInput for others."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content)) as image:
            return channels(np.asarray(image if image.mode == "L" else image.convert("RGB")))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise BadInput(f"a compressed image cannot be read: {str(error).partition('<')[0].strip()}") from None


def channels(image: NDArray[Any]) -> NDArray[Any]:
    """(H, W) of an image with one channel, (H, W, 3) without transparency, in the byte order of the machine."""
    image = image.astype(image.dtype.newbyteorder("="), copy=False)
    return image[:, :, 0] if image.ndim == 3 and image.shape[2] == 1 else image[..., :3] if image.ndim == 3 else image

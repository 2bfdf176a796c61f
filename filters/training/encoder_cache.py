"""Cached outputs of frozen image encoders: each distinct image is encoded once, on its first look-up by its index.

Encoding images takes nearly all of a training step's time, and the output of a frozen encoder never changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from beliefscope.filters.batch import Steps
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.networks import IMAGES_CHUNK, ImageEncoder

Images = Mapping[str, Tensor]
"""Modality -> (P, H, W) uint8, all different."""


def index_images(sets: Sequence[Steps]) -> tuple[list[Steps], Images]:
    """The sets of steps with an index in place of each image, and the distinct images, ordered by first occurrence."""
    observations = [dict(steps.observations) for steps in sets]
    images: dict[str, Tensor] = {}
    for modality, values in sets[0].observations.items():
        if values.dtype != torch.uint8:
            continue
        joined = torch.cat([steps.observations[modality] for steps in sets])
        rows = np.ascontiguousarray(joined.cpu().numpy().reshape(len(joined), -1))
        rows = rows.view(np.dtype((np.void, rows.shape[1]))).ravel()
        _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
        images[modality] = joined[torch.from_numpy(np.sort(first)).to(values.device)]
        ranks = np.argsort(np.argsort(first))  # consecutive steps are encoded together
        indices = torch.from_numpy(ranks[inverse].astype(np.int64)).to(values.device)
        for indexed, part in zip(observations, indices.split([len(steps.states) for steps in sets]), strict=True):
            indexed[modality] = part
    return [replace(steps, observations=indexed) for steps, indexed in zip(sets, observations, strict=True)], images


class LazyFeatures:
    """Features (P, units) of images (P, H, W), uint8; blocks of them are encoded on first use.

    Blocks do not depend on the order of use, and so the bits of the features do not either.
    """

    def __init__(self, filter_: Filter, modality: str, encoder: ImageEncoder, images: Tensor) -> None:
        self._encode = partial(encode_images, filter_, modality, encoder)
        self._images, self._features = images, torch.empty(0)
        self._missing = torch.ones(-(-len(images) // IMAGES_CHUNK), dtype=torch.bool, device=images.device)

    def __getitem__(self, indices: Tensor) -> Tensor:
        """Indices (...) to features (..., units)."""
        blocks = (indices.flatten() // IMAGES_CHUNK).unique()
        for block in blocks[self._missing[blocks]].tolist():
            first = min(block * IMAGES_CHUNK, max(len(self._images) - IMAGES_CHUNK, 0))  # the last one is whole, too
            features = self._encode(self._images[first : first + IMAGES_CHUNK])
            if not len(self._features):
                self._features = features.new_empty(len(self._images), features.shape[-1])
            self._features[first : first + IMAGES_CHUNK] = features
            self._missing[block] = False
        return self._features[indices]


Tables = dict[tuple[str, bytes, bytes], LazyFeatures]
"""Modality, weights of an encoder, and mean and standard deviation of its images -> features of these."""


@contextmanager
def cached_encoders(filter_: Filter, images: Images, tables: Tables | None = None) -> Iterator[None]:
    """Within this context the filter takes image indices: frozen encoders look up features, others encode the image.

    An encoder counts as frozen if none of its parameters requires a gradient on entry. Results differ from those on
    images only by rounding, since sums are taken in another order.

    Args:
        tables: features of these images that are known; new ones are added.
    """
    encoders = [
        (name.rpartition(".by_modality.")[2], module)
        for name, module in filter_.named_modules()
        if isinstance(module, ImageEncoder)
    ]
    tables = {} if tables is None else tables
    try:
        for modality, encoder in encoders:
            if any(parameter.requires_grad for parameter in encoder.parameters()):
                encoder.images = lambda n, m=modality: filter_.statistics.standardise(m, images[m][n])
                continue
            scaling = torch.stack(filter_.statistics.mean_std(modality)).cpu().numpy().tobytes()
            key = modality, weights_key(encoder), scaling
            if key not in tables:
                tables[key] = LazyFeatures(filter_, modality, encoder, images[modality])
            encoder.table = tables[key]
        yield
    finally:
        for _, encoder in encoders:
            encoder.table = encoder.images = None


def weights_key(encoder: ImageEncoder) -> bytes:
    """The encoder's parameters as bytes: encoders with equal weights share one table."""
    return torch.cat([p.detach().flatten() for p in encoder.parameters()]).cpu().numpy().tobytes()


@torch.no_grad()
def encode_images(filter_: Filter, modality: str, encoder: ImageEncoder, images: Tensor) -> Tensor:
    """(P, units) features of images (P, H, W), uint8."""
    parts = images.split(encoder.chunk)
    return torch.cat([encoder(filter_.statistics.standardise(modality, part)) for part in parts])

"""Frozen encoders asked once: every different picture gets a number, and what they say to it is looked up.

Pictures cost nearly all of a training step's time, and what a frozen encoder says to one never changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from beliefscope.filters.batch import Steps
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.networks import PICTURES_AT_ONCE, ImageEncoder

Pictures = Mapping[str, Tensor]
"""Modality -> (P, H, W) uint8, no two alike."""


def numbered(sets: Sequence[Steps]) -> tuple[list[Steps], Pictures]:
    """The sets of steps with a number in place of each picture, and the pictures. All black ones are the same."""
    observations = [dict(steps.observations) for steps in sets]
    pictures: dict[str, Tensor] = {}
    for modality, values in sets[0].observations.items():
        if values.dtype != torch.uint8:
            continue
        joined = torch.cat([steps.observations[modality] for steps in sets])
        rows = np.ascontiguousarray(joined.cpu().numpy().reshape(len(joined), -1))
        whole = rows.view(np.dtype((np.void, rows.shape[1]))).ravel()
        _, first, number = np.unique(whole, return_index=True, return_inverse=True)
        pictures[modality] = joined[torch.from_numpy(first).to(values.device)]
        numbers = torch.from_numpy(number.astype(np.int64)).to(values.device)
        for found, part in zip(observations, numbers.split([len(steps.states) for steps in sets]), strict=True):
            found[modality] = part
    return [replace(steps, observations=found) for steps, found in zip(sets, observations, strict=True)], pictures


@contextmanager
def recalling(
    filter_: Filter, pictures: Pictures, progress: Callable[[float], None] = lambda share: None
) -> Iterator[None]:
    """Within, the filter takes numbers for pictures: frozen encoders look up, others encode what the number stands for.

    Encoders are frozen where no parameter requires a gradient on entry. Results differ from those on pictures only as
    sums in another order do.
    """
    work = [
        (name.rpartition(".by_modality.")[2], module)
        for name, module in filter_.named_modules()
        if isinstance(module, ImageEncoder)
    ]
    tables: dict[tuple[str, bytes], Tensor] = {}
    try:
        for done, (modality, encoder) in enumerate(work):
            if any(parameter.requires_grad for parameter in encoder.parameters()):
                encoder.pictures = lambda n, m=modality: filter_.statistics.standardise(m, pictures[m][n])
                continue
            # Encoders that are the same share a table.
            key = modality, torch.cat([p.detach().flatten() for p in encoder.parameters()]).cpu().numpy().tobytes()
            if key not in tables:
                tables[key] = _table(filter_, modality, encoder, pictures[modality])
            encoder.table = tables[key]
            progress((done + 1) / len(work))
        yield
    finally:
        for _, encoder in work:
            encoder.table = encoder.pictures = None


@torch.no_grad()
def _table(filter_: Filter, modality: str, encoder: ImageEncoder, pictures: Tensor) -> Tensor:
    """(P, units) what the encoder says to each picture."""
    parts = pictures.split(PICTURES_AT_ONCE)
    return torch.cat([encoder(filter_.statistics.standardise(modality, part)) for part in parts])

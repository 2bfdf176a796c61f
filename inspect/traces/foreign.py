"""Traces of filters from outside: what could be captured, and nothing in place of the rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import WHOLE, Faults
from beliefscope.filters.external.load import Foreign
from beliefscope.inspect.trace import Trace


def trace_foreign(
    foreign: Foreign,
    episode: Episode,
    episode_index: int = 0,
    seed: int = 0,
    faults: Faults = WHOLE,
    progress: Callable[[float], None] | None = None,
) -> Trace:
    """Runs a filter from outside over an episode from the true state, and keeps what it says and what can be seen.

    What is not known is None; where a trace must have it, it is NaN: covariances, and what each modality alone believes
    (K is 0 where nothing tells modalities apart).

    Args: as ``trace``.

    Raises BadInput: as ``trace``, and where the filter fails or gives what is not as it should be.
    """
    if episode.task != foreign.task.name:
        raise BadInput(f"filter {foreign.name!r} is for task {foreign.task.name!r}, the episode is of {episode.task!r}")
    data_hash = episode.digest()
    episode = faults.apply(episode, seed)
    values, modalities = foreign.run([episode], seed, progress)
    start = foreign.start([episode])
    arrays = {name: np.ascontiguousarray(value[:, 0].numpy()) for name, value in values.items()}
    settings: dict[str, Any] = {"torch": torch.__version__, "source": foreign.source}
    if "particles" in arrays:
        settings["particles"] = arrays["particles"].shape[1]
    return Trace(
        episode=episode,
        modalities=modalities,
        kind=foreign.kind,
        filter=foreign.name,
        start_mean=start.mean[0].numpy(),
        start_covariance=np.ascontiguousarray(start.covariance[0].numpy()),
        checkpoint_hash=foreign.hash,
        data_hash=data_hash,
        episode_index=episode_index,
        seed=seed,
        faults=faults,
        settings=settings,
        **with_unknown(arrays, len(modalities)),
    )


def with_unknown(arrays: Mapping[str, NDArray[Any]], k: int) -> dict[str, NDArray[Any]]:
    """The arrays by name, and NaN for what every trace has of K models and is not among them."""
    steps, n = arrays["estimate_mean"].shape
    shapes = {
        "estimate_covariance": (steps, n, n),
        "modality_mean": (steps, k, n),
        "modality_covariance": (steps, k, n, n),
    }
    return {name: np.full(shape, np.nan, np.float32) for name, shape in shapes.items()} | dict(arrays)

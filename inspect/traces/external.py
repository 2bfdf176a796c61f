"""Traces of external filters: returned values and values captured by hooks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.engine import Progress
from beliefscope.filters.external.adapter import EXTRA, Values, letters_of
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.traces.data import Trace

SAME = 1e-4
"""Largest rounding difference between runs alone and in a batch, relative to a value and to the largest one."""


def trace_external(
    external: ExternalFilter,
    episode: Episode,
    episode_index: int = 0,
    seed: int = 0,
    faults: Faults = NO_FAULTS,
    progress: Progress = None,
) -> Trace:
    """Run an external filter over an episode from the true state, with the arguments of ``trace``.

    Values that are not available are None, or NaN for required fields: covariances and unimodal posteriors. K is 0
    if the filter does not report separate modalities.

    Raises BadInput as ``trace``, and if the filter fails or returns invalid values.
    """
    external.check_task(episode)
    run: dict[str, Any] = {"episode_index": episode_index, "seed": seed, "faults": faults}
    return run_external(external, faults.apply(episode, seed), progress, data_hash=episode.digest(), **run)


def run_external(
    external: ExternalFilter,
    episode: Episode,
    progress: Progress = None,
    *,
    seen: Episode | None = None,
    **provenance: Any,
) -> Trace:
    """The trace of a run over an episode after fault injection.

    Args:
        seen: episode that the filter runs on, if it lacks sensors of the trace's episode. Such a trace has no values
            of single modalities.
        provenance: trace fields that identify the run.
    """
    start = external.start([episode])
    values, modalities = external.run([seen or episode], provenance["seed"], progress, start)
    if seen is not None:
        modalities, values = (), {name: v for name, v in values.items() if not letters_of(name).startswith("K")}
    return _assemble(external, episode, 0, start, values, modalities, provenance)


def run_together(
    external: ExternalFilter, episodes: Sequence[Episode], progress: Progress, provenance: Sequence[Mapping[str, Any]]
) -> list[Trace]:
    """As ``run_external`` for episodes of equal length in one batch, each with its provenance."""
    start = external.start(episodes)
    values, modalities = external.run(episodes, provenance[0]["seed"], progress, start)
    return [
        _assemble(external, episode, i, start, values, modalities, own)
        for i, (episode, own) in enumerate(zip(episodes, provenance, strict=True))
    ]


def are_independent(external: ExternalFilter, episodes: Sequence[Episode], seed: int) -> bool:
    """Whether the values of an episode are the same alone and in a batch of several, except for rounding.

    They differ if a filter draws random numbers or has operations over the batch. Raises BadInput as ``run_external``.
    """
    (alone, names), (together, others) = (external.run(group, seed) for group in (episodes[:1], episodes))
    return (names, alone.keys()) == (others, together.keys()) and all(
        torch.allclose(value.double(), together[name][:, :1].double(), SAME, SAME * _size(value), equal_nan=True)
        for name, value in alone.items()
    )


def _size(values: Tensor) -> float:
    finite = values[values.isfinite()].abs()
    return float(finite.max()) if len(finite) else 0.0


def _assemble(
    external: ExternalFilter,
    episode: Episode,
    i: int,
    start: Gaussian,
    values: Values,
    modalities: tuple[str, ...],
    provenance: Mapping[str, Any],
) -> Trace:
    """The trace of episode i of a batch."""
    arrays = {name: np.ascontiguousarray(value[:, i].numpy()) for name, value in values.items()}
    settings: dict[str, Any] = {"torch": torch.__version__, "source": external.source}
    if "particles" in arrays:
        settings["particles"] = arrays["particles"].shape[1]
    return Trace(
        episode=episode,
        modalities=modalities,
        kind=external.kind,
        filter=external.name,
        start_mean=start.mean[i].numpy(),
        start_covariance=np.ascontiguousarray(start.covariance[i].numpy()),
        checkpoint_hash=external.hash,
        **{**provenance, "settings": settings | dict(provenance.get("settings", {}))},
        **fill_missing(arrays, len(modalities)),
    )


def fill_missing(arrays: Mapping[str, NDArray[Any]], k: int) -> dict[str, Any]:
    """The arrays, with NaN for required arrays of K models that are missing; ``extra`` as a dictionary."""
    steps, n = arrays["estimate_mean"].shape
    shapes = {
        "estimate_covariance": (steps, n, n),
        "modality_mean": (steps, k, n),
        "modality_covariance": (steps, k, n, n),
    }
    missing = {name: np.full(shape, np.nan, np.float32) for name, shape in shapes.items()}
    own = {name: value for name, value in arrays.items() if not name.startswith(EXTRA)}
    extra = {name.removeprefix(EXTRA): value for name, value in arrays.items() if name.startswith(EXTRA)}
    return missing | own | ({"extra": extra} if extra else {})

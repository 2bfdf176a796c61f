"""Traces of external filters: returned values and values captured by hooks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.filters.engine import Progress
from beliefscope.filters.external.adapter import EXTRA, letters_of
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.traces.data import Trace


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
    arrays = {name: np.ascontiguousarray(value[:, 0].numpy()) for name, value in values.items()}
    settings: dict[str, Any] = {"torch": torch.__version__, "source": external.source}
    if "particles" in arrays:
        settings["particles"] = arrays["particles"].shape[1]
    return Trace(
        episode=episode,
        modalities=modalities,
        kind=external.kind,
        filter=external.name,
        start_mean=start.mean[0].numpy(),
        start_covariance=np.ascontiguousarray(start.covariance[0].numpy()),
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

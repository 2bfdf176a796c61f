"""Validation of loaded traces: array shapes and types, and metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from beliefscope.datasets.dataset import SPLITS
from beliefscope.datasets.episode import time_error
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.external.adapter import SHAPES
from beliefscope.filters.filter import Kind
from beliefscope.inspect.traces.data import STATIC, Trace

KINDS = (*get_args(Kind), "external")
LARGEST_SEED = 2**63 - 1


def validate_trace(trace: Trace) -> None:
    """Raise BadInput naming the first field with an impossible value."""
    episode = trace.episode
    _check(trace.kind in KINDS, "kind", trace.kind)
    for name in ("filter", "checkpoint_hash", "data_hash"):
        _check(isinstance(getattr(trace, name), str), name, getattr(trace, name))
    for name, index in (("episode_index", trace.episode_index), ("seed", trace.seed)):
        _check(type(index) is int and 0 <= index <= LARGEST_SEED, name, index)
    _check(all(isinstance(name, str) for name in trace.modalities), "modalities", trace.modalities)
    _check(isinstance(trace.settings, Mapping), "settings", trace.settings)
    _check(type(episode.dt) in (int, float) and 0 < episode.dt < math.inf, "dt of the episode", episode.dt)
    _check(type(episode.seed) is int and abs(episode.seed) <= LARGEST_SEED, "seed of the episode", episode.seed)
    _check(episode.split in SPLITS, "split of the episode", episode.split)
    _check(isinstance(episode.provenance, Mapping), "provenance of the episode", episode.provenance)
    sizes = {"T": len(np.atleast_1d(trace.estimate_mean)), "K": len(trace.modalities)}
    shapes = {name: f"T{letters}" for name, letters in SHAPES.items()} | STATIC
    for name, letters in shapes.items():
        _check_array(name, getattr(trace, name), letters, sizes, "i" if name == "ancestors" else "f")
    _check_array("all_particles_ess", trace.all_particles_ess, "T", sizes, "f")
    if trace.all_particles_ess is not None:
        total, kept = trace.settings.get("particles"), sizes.get("M", 0)
        _check(type(total) is int and total > kept > 0, f"number of particles with {kept} kept", total)
    for name, values in trace.extra.items():
        _check_array(f"extra {name!r}", values, "T", sizes, "f")
    for name, letters, kinds in (("states", "Tn", "f"), ("controls", "Tc", "f"), ("contact", "T", "b")):
        _check_array(name, getattr(episode, name), letters, sizes, kinds)
    _check_array("qpos", episode.qpos, "Tq", sizes, "f")
    _check_array("time", episode.time, "T", sizes, "f")
    if episode.time is not None and (error := time_error(episode.time)):
        raise BadInput(f"time {error}")
    for name, values in episode.covariates.items():
        _check_array(f"covariate {name!r}", values, "T", sizes, "f")
    for name, values in episode.observations.items():
        _check_array(f"observation {name!r}", values, "T" + "_" * (np.ndim(values) - 1), sizes, "biuf")
    ancestors, particles = trace.ancestors, sizes.get("M", 0)
    if ancestors is not None and ancestors.size and not 0 <= ancestors.min() <= ancestors.max() < particles:
        raise BadInput(f"ancestors are {ancestors.min()} to {ancestors.max()}, the trace has {particles} particles")


def _check(valid: bool, name: str, value: Any) -> None:
    if not valid:
        raise BadInput(f"{name} is {value!r:.200}")


def _check_array(name: str, array: Any, letters: str, sizes: dict[str, int], kinds: str) -> None:
    """Check dtype and shape. Letters stand for sizes as in the conventions; each must be equal in all arrays."""
    if array is None:
        return
    if array.dtype.kind not in kinds:
        raise BadInput(f"{name} is {array.dtype}")
    expected = [sizes.get(letter, "any") for letter in letters]
    if array.ndim != len(letters) or any(n not in ("any", m) for n, m in zip(expected, array.shape, strict=True)):
        raise BadInput(f"{name} has shape {array.shape}, expected ({', '.join(map(str, expected))})")
    sizes |= {letter: size for letter, size in zip(letters, array.shape, strict=True) if letter != "_"}

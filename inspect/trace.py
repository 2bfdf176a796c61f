"""A trace: everything a filter knew at every step of one episode. All that is shown or recorded reads only this."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Trace:
    """T steps, K modalities, n state components, M particles; SI units (m, rad), float32 unless said.

    Index t is step t of the episode. The belief before step 0 is ``start_mean``, ``start_covariance``.
    Fields that a kind of filter does not have are None.

    Attributes:
        episode: what was filtered: truth, contact, observations as the filter saw them, replay.
        modalities: the K modalities' names, in the order of every K axis.
        kind: ``ekf`` or ``pf``.
        estimate_mean, estimate_covariance: (T, n), (T, n, n) fused posterior.
        modality_mean, modality_covariance: (T, K, n), (T, K, n, n): each modality's own belief (see ``StepTrace``).
        weights: (T, K, W) beta as the network gave it; W is n (per component) or 1. acting: (T, K, W) share as it acted.
        predicted_mean, predicted_covariance: EKF: (T, K, n), (T, K, n, n).
        observation_mean, observation_covariance: EKF: (T, K, n), (T, K, n, n): virtual sensors' z and R.
        particles: PF: (T, M, n) predicted particles. prior_log_weights, log_weights: (T, M) before and after the
            observation, both normalised. log_likelihood: (T, K, M), not normalised. ancestors: (T, M) int32.
        start_mean, start_covariance: (n,), (n, n) belief before the first step.
        checkpoint_hash, data_hash: SHA-256 of the checkpoint's file and of the episode (``Episode.digest``).
        episode_index: index in its data set. filter: its name. seed: of the filter's randomness.
        settings: JSON values: particles, options, versions.
    """

    episode: Episode
    modalities: tuple[str, ...]
    kind: str
    filter: str
    estimate_mean: Array
    estimate_covariance: Array
    modality_mean: Array
    modality_covariance: Array
    start_mean: Array
    start_covariance: Array
    weights: Array | None = None
    acting: Array | None = None
    predicted_mean: Array | None = None
    predicted_covariance: Array | None = None
    observation_mean: Array | None = None
    observation_covariance: Array | None = None
    particles: Array | None = None
    prior_log_weights: Array | None = None
    log_weights: Array | None = None
    log_likelihood: Array | None = None
    ancestors: NDArray[np.int32] | None = None
    checkpoint_hash: str = ""
    data_hash: str = ""
    episode_index: int = 0
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.estimate_mean)

"""The trace: intermediate results of a filter at every step of one episode.

Page, recordings, diagnostics and reports read only this.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.notebook_html import html_paragraph, html_table
from beliefscope.datasets.task import Task
from beliefscope.datasets.text import plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.models.resampling import effective_sample_size

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Trace:
    """T steps, K modalities, n state components, M particles; SI units (m, rad), float32 unless noted.

    Index t is step t of the episode. ``start_mean`` and ``start_covariance`` are the belief before step 0.
    Fields that do not apply to a kind of filter are None.

    Attributes:
        episode: filter input: true states, contact, observations after fault injection, data for the replay.
        modalities: names of the K measurement models, in the order of every K axis: a modality, or several joined by
            ``+`` that share one model. Empty for an LSTM or transformer, which have no measurement models (K = 0).
        kind: ``ekf``, ``ukf``, ``pf``, ``lstm``, ``transformer`` or ``external``. An external filter has the fields
            that could be captured. Statements about EKFs below hold for UKFs as well.
        filter: filter name.
        estimate_mean, estimate_covariance: (T, n), (T, n, n) fused posterior. LSTM, transformer: the covariance is NaN.
        modality_mean, modality_covariance: (T, K, n), (T, K, n, n) single-modality updates: the prior of
            this step, updated with one modality only. PF: the predicted particles weighted by one likelihood. EKF:
            the posterior of each filter of the bank. The prior comes from the fused belief, and so from all
            modalities; standalone runs (``inspect/standalone.py``) are less accurate. Only a bank of EKFs without
            feedback separates the modalities: its updates are the standalone estimates.
        start_mean, start_covariance: (n,), (n, n) belief before the first step.
        weights: (T, K, W) fusion weights beta, the network's output; W is n (per component) or 1.
        effective_weights: (T, K, W) share of each modality in the posterior; sums to one over K. None where K < 2.
            Crossmodal EKF: beta normalised over modalities. Unimodal EKF, W = n: the diagonal of S S_k^-1, its share
            of each mean. PF: prior weight x beta x likelihood of one modality over the total, summed over particles.
        predicted_mean, predicted_covariance: EKF: (T, K, n), (T, K, n, n) prior before the observation.
        observation_mean, observation_covariance: filters with virtual sensors: (T, K, n), (T, K, n, n) their output z
            and R.
        particles: PF: (T, M, n) predicted particles.
            M is the number kept; moments and effective weights are those of all.
        prior_log_weights, log_weights: PF: (T, M) normalised, before and after the observation.
        log_likelihood: PF: (T, K, M), not normalised.
        ancestors: PF: (T, M) int32 index of the particle that each resampled particle was copied from. None if not all
            particles are kept.
        all_particles_ess: (T,) effective sample size of all particles, if not all are kept.
        innovation, innovation_covariance: external filters: (T, K, m), (T, K, m, m) in the space and units of each
            measurement; NaN after its last channel and where there was none.
        accepted: external filters with a gate: (T, K) 1 if the measurement was used, 0 if not; NaN without one.
        extra: external filters: name -> (T,) scalar of the filter, in its own unit.
        checkpoint_hash, data_hash: SHA-256 of the checkpoint file and of the episode (``Episode.digest``).
        episode_index: index in the data set.
        seed: seed of the filter and of the fault injection.
        faults: injected sensor faults; ``data_hash`` is of the episode before injection.
        settings: JSON values: particles, versions; ``edits``: interventions; ``standalone``: the modality of that run.
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
    effective_weights: Array | None = None
    predicted_mean: Array | None = None
    predicted_covariance: Array | None = None
    observation_mean: Array | None = None
    observation_covariance: Array | None = None
    particles: Array | None = None
    prior_log_weights: Array | None = None
    log_weights: Array | None = None
    log_likelihood: Array | None = None
    ancestors: NDArray[np.int32] | None = None
    all_particles_ess: Array | None = None
    innovation: Array | None = None
    innovation_covariance: Array | None = None
    accepted: Array | None = None
    extra: Mapping[str, Array] = field(default_factory=dict)
    checkpoint_hash: str = ""
    data_hash: str = ""
    episode_index: int = 0
    seed: int = 0
    faults: Faults = NO_FAULTS
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.estimate_mean)

    def __repr__(self) -> str:
        """One line; the arrays have millions of values."""
        faults = f", {self.faults}" if self.faults else ""
        run = f"{self.filter} over {plural(len(self), 'step')} of {self.task.name} episode {self.episode_index}"
        return f"<Trace: {run}, seed {self.seed}{faults}>"

    def _repr_html_(self) -> str:
        """The run, and name, shape and type of each array that it has, in a notebook."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self)} | {"states": self.episode.states}
        rows = [(k, " x ".join(map(str, v.shape)), v.dtype) for k, v in arrays.items() if isinstance(v, np.ndarray)]
        return html_paragraph(repr(self)[1:-1], strong=True) + html_table("", ["array", "shape", "type"], rows)

    @property
    def task(self) -> Task:
        """Definition of the task, which travels with the trace."""
        return self.episode.task

    @property
    def particle_count(self) -> int | None:
        """Number of particles of the run, kept or not; None for a filter without particles."""
        if self.particles is None:
            return None
        return self.particles.shape[1] if self.all_particles_ess is None else int(self.settings["particles"])

    @property
    def has_covariance(self) -> bool:
        """Whether the estimates have a covariance; those of an LSTM or transformer do not.

        Zeros are unknown, except those of particles, which may collapse.
        """
        covariance = self.estimate_covariance
        unknown = np.isnan(covariance) if self.particles is not None else np.isnan(covariance) | (covariance == 0.0)
        return not unknown.all() or not len(self)

    @property
    def modalities_with_posterior(self) -> tuple[str, ...]:
        """The modalities if their unimodal posteriors are available, otherwise empty."""
        return () if np.isnan(self.modality_mean).all() else self.modalities

    @property
    def anchors(self) -> Array:
        """(T, n) centres of likelihood maps and drawings: the true state, or the estimate where it is unknown."""
        truth = self.episode.states
        return np.where(np.isnan(truth), self.estimate_mean, truth)

    @property
    def effective_sample_size(self) -> Array | None:
        """(T,) ``1 / sum w_i^2`` of all posterior weights; None for a filter without particles."""
        if self.all_particles_ess is not None:
            return self.all_particles_ess
        return None if self.log_weights is None else effective_sample_size(torch.from_numpy(self.log_weights)).numpy()


ARRAYS = tuple(f.name for f in fields(Trace) if "Array" in str(f.type) and "Mapping" not in str(f.type))
"""Names of the array fields of a trace."""


STATIC = {"start_mean": "n", "start_covariance": "nn"}
"""Arrays of a trace without a step axis, and their shapes."""

PROVENANCE = ("data_hash", "episode_index", "seed", "faults", "settings")
"""Fields of a trace that identify its run, beside those of the filter."""


def provenance_of(trace: Trace) -> dict[str, Any]:
    """The values of ``PROVENANCE``."""
    return {name: getattr(trace, name) for name in PROVENANCE}


def standalone_provenance(trace: Trace, modality: str) -> dict[str, Any]:
    """``provenance_of`` a standalone run of a modality, in which the weights of interventions play no part."""
    settings = {key: value for key, value in trace.settings.items() if key != "edits"} | {"standalone": modality}
    return provenance_of(trace) | {"settings": settings}


def check_origin(checkpoint: Checkpoint, trace: Trace) -> None:
    """Raise BadInput for a trace of another filter."""
    if trace.checkpoint_hash != checkpoint.hash:
        raise BadInput(f"the trace is from checkpoint {trace.checkpoint_hash[:12]}, not from {checkpoint.hash[:12]}")


def check_step(step: int, steps: int, of: str = "trace") -> None:
    """Raise BadInput for a step that is not among the steps of a trace or episode."""
    if not 0 <= step < steps:
        raise BadInput(f"step {step} is not in this {of}: it has steps 0 to {steps - 1}")


def arrays_of(trace: Trace) -> dict[str, NDArray[Any]]:
    """All arrays of a trace by name; those of its episode start with ``episode/``, its own scalars with ``extra/``."""
    episode = trace.episode
    arrays: dict[str, NDArray[Any]] = {
        name: getattr(trace, name) for name in ARRAYS if getattr(trace, name) is not None
    }
    arrays |= {f"extra/{name}": value for name, value in trace.extra.items()}
    arrays |= {f"episode/{name}": getattr(episode, name) for name in ("states", "controls", "contact", "qpos")}
    arrays |= {} if episode.time is None else {"episode/time": episode.time}
    arrays |= {f"episode/covariates/{key}": value for key, value in episode.covariates.items()}
    return arrays | {f"episode/observations/{key}": value for key, value in episode.observations.items()}

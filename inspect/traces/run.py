"""Run a filter over an episode and assemble the trace, as a whole or in parts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.episode_parts import STEPS_PER_PART, EpisodeParts
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.filters.batch import Batch, Steps, check_shapes
from beliefscope.filters.belief import Evidence, Gaussian, Particles, StepTrace, reweighted
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress, one_thread
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Filter, Kind
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.fusion import only_present, powers_of_present
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.filters.models.resampling import effective_sample_size
from beliefscope.filters.rollout import first_belief
from beliefscope.inspect.traces.data import Trace
from beliefscope.inspect.traces.external import trace_external

PARTICLES_KEPT = 10_000
"""Particles of each step that a trace stores by default."""

PARTICLES_AT_ONCE = 1 << 21
"""Particles whose arrays are computed at once if not all are kept; limits memory."""


@torch.no_grad()
def trace(
    checkpoint: Checkpoint,
    episode: Episode,
    episode_index: int = 0,
    seed: int = 0,
    particles: int = 300,
    faults: Faults = NO_FAULTS,
    progress: Progress = None,
    particles_kept: int = PARTICLES_KEPT,
) -> Trace:
    """Run a filter over an episode from the true state, covariance 0.1 I (standardised), and keep every step.

    Estimates are bit-identical to those of an untraced run with the same seed. Memory is linear in the steps, with the
    size of the trace's arrays and of the episode, and does not depend on ``particles`` times steps.

    Args:
        faults: sensor faults to inject; the trace's episode holds the observations after injection.
        progress: called with the completed fraction, 0..1.
        particles_kept: maximum number of particles of each step in the trace: every (particles / particles_kept)-th.
            Moments, effective weights and the effective sample size are those of all particles.

    Raises:
        BadInput: the episode or the faults do not fit the checkpoint's task, or a setting is out of range.
    """
    faults.check(checkpoint.task, len(episode))
    if isinstance(checkpoint, ExternalFilter):
        return trace_external(checkpoint, episode, episode_index, seed, faults, progress)
    run = start_run(checkpoint, episode, episode_index, seed, particles, faults)
    blocks, total = encoded(run.filter, run.episode), len(episode)
    parts = run_parts(checkpoint, blocks, total, run.start, run.generator(), particles, particles_kept, progress)
    return assemble_trace(checkpoint, run.episode, run.start, join_parts(parts, total), **run.provenance)


@torch.no_grad()
def trace_parts(
    checkpoint: Checkpoint,
    episode: EpisodeParts,
    episode_index: int = 0,
    seed: int = 0,
    particles: int = 300,
    progress: Progress = None,
    particles_kept: int = PARTICLES_KEPT,
) -> Iterator[Trace]:
    """Yields consecutive parts of the trace of a built-in filter, with the same bits as ``trace``.

    Memory does not grow with the steps. Arguments and errors as for ``trace``.
    """
    run = start_run(checkpoint, episode.part(0, 1), episode_index, seed, particles, NO_FAULTS)
    provenance, done = {**run.provenance, "data_hash": episode.digest()}, 0
    blocks = encoded(checkpoint.filter, episode)
    with one_thread():
        for arrays in run_parts(
            checkpoint, blocks, len(episode), run.start, run.generator(), particles, particles_kept, progress
        ):
            first, done = done, done + len(arrays["estimate_mean"])
            yield assemble_trace(checkpoint, episode.part(first, done), run.start, arrays, **provenance)


@dataclass(frozen=True)
class FilterRun:
    """A run over an episode before its first step.

    Attributes:
        episode: filter input, after fault injection.
        filter: of the run.
        start: belief before step 0, N = 1.
        provenance: trace fields that identify the run.
    """

    episode: Episode
    filter: Filter
    start: Gaussian
    provenance: Mapping[str, Any]

    @cached_property
    def evidence(self) -> Evidence:
        """Evidence of all steps."""
        with torch.no_grad():
            return self.filter.encode(_batch(self.filter, self.episode))

    def generator(self) -> torch.Generator:
        """A new generator of the run's random numbers."""
        return torch.Generator().manual_seed(self.provenance["seed"])


@torch.no_grad()
def start_run(
    checkpoint: Checkpoint, episode: Episode, episode_index: int, seed: int, particles: int, faults: Faults
) -> FilterRun:
    """Inject faults and check the episode. Arguments and errors as for ``trace``."""
    if particles < 1:
        raise BadInput(f"particles must be at least 1, not {particles}")
    checkpoint.check_task(episode)
    filter_ = checkpoint.filter
    provenance = {"data_hash": episode.digest(), "episode_index": episode_index, "seed": seed, "faults": faults}
    episode = faults.apply(episode, seed)
    check_shapes(filter_.task, episode, f"episode {episode_index}")
    start = first_belief(filter_, _batch(filter_, episode.part(0, 1)))
    settings = {"particles": particles, "torch": torch.__version__}
    return FilterRun(episode, filter_, start, provenance | {"settings": settings})


def encoded(filter_: Filter, episode: Episode | EpisodeParts) -> Iterator[Evidence]:
    """Evidence of consecutive steps, a limited number at once."""
    for first in range(0, len(episode), STEPS_PER_PART):
        lead = min(first, filter_.history)
        part = episode.part(first - lead, min(first + STEPS_PER_PART, len(episode)))
        yield filter_.encode_after(_batch(filter_, part), lead)


def _batch(filter_: Filter, episode: Episode) -> Batch:
    """All steps of an episode, N = 1."""
    return Steps.from_episodes(filter_.task, [episode]).episode(0)


@one_thread()  # the tensors of one trajectory are too small for several
def join_parts(parts: Iterable[dict[str, Tensor]], total: int) -> dict[str, Tensor]:
    """The arrays (T, ...) of a trace from those of ``run_parts``, which run in one thread. total: T."""
    arrays: dict[str, Tensor] = {}
    done = 0
    for part in parts:
        first, done = done, done + len(part["estimate_mean"])
        if done - first == total:
            return part
        for name, values in part.items():
            if name not in arrays:  # once: small arrays that stay between large ones would fragment the memory
                arrays[name] = values.new_empty(total, *values.shape[1:])
            arrays[name][first:done] = values
    return arrays


def run_parts(
    checkpoint: Checkpoint,
    blocks: Iterable[Evidence],
    total: int,
    start: Gaussian,
    generator: torch.Generator,
    particles: int,
    particles_kept: int,
    progress: Progress,
) -> Iterator[dict[str, Tensor]]:
    """Run a filter over consecutive evidence with N = 1; yields the arrays of its trace by block of steps.

    Args:
        total: number of all steps.
        progress: called with the completed fraction, 0..1.

    Raises BadInput for ``particles_kept`` below 1.
    """
    if particles_kept < 1:
        raise BadInput(f"particles kept must be at least 1, not {particles_kept}")
    filter_ = checkpoint.filter
    belief, done = filter_.start(start, particles, generator), 0
    for block in blocks:
        at_once = len(block)
        if isinstance(belief, Particles) and particles > particles_kept:
            at_once = max(1, PARTICLES_AT_ONCE // particles)
        for first in range(0, len(block), at_once):
            evidence = block[first : first + at_once]
            steps: list[StepTrace] = []
            for after, step in filter_.steps(belief, evidence, generator):
                belief = after
                steps.append(step)
                done += 1
                if progress is not None:
                    progress(done / total)
            yield with_fewer_particles(step_arrays(checkpoint, evidence, steps), particles_kept)


BY_PARTICLE = {"particles": -2, "prior_log_weights": -1, "log_weights": -1, "log_likelihood": -1}
"""Arrays with a value for each particle, and the axis of the particles."""


def with_fewer_particles(arrays: dict[str, Tensor], count: int) -> dict[str, Tensor]:
    """Arrays (T, ...) with at most ``count`` particles at equal distances, and the effective sample size of all.

    Resampled particles are in the order of their ancestors, so those at equal distances are a stratified sample of the
    prior. Weights are normalised again. Ancestors are left out: most of them are not kept.
    """
    total = arrays["particles"].shape[1] if "particles" in arrays else 0
    if total <= count:
        return arrays
    kept = torch.linspace(0, total - 1, count, dtype=torch.float64).round().long()
    result = {name: values for name, values in arrays.items() if name != "ancestors"}
    result["all_particles_ess"] = effective_sample_size(arrays["log_weights"])
    for name, axis in BY_PARTICLE.items():
        result[name] = arrays[name].index_select(axis, kept)
    for name in ("prior_log_weights", "log_weights"):
        result[name] = result[name].log_softmax(-1)
    return result


def step_arrays(checkpoint: Checkpoint, evidence: Evidence, steps: Sequence[StepTrace]) -> dict[str, Tensor]:
    """Arrays (T, ...) of a trace.

    Args:
        evidence: of T steps, N = 1. steps: T steps with N = 1, or one whose tensors have T as their leading axis.
    """
    filter_ = checkpoint.filter
    si = filter_.statistics
    arrays = ARRAYS_OF[checkpoint.kind](filter_, steps, evidence)
    arrays["estimate_mean"] = si.state_to_si(torch.cat([s.estimate.mean for s in steps]))
    arrays["estimate_covariance"] = si.covariance_to_si(torch.cat([s.estimate.covariance for s in steps]))
    if evidence.log_weights is not None:
        arrays["weights"] = evidence.log_weights[:, 0].exp()
    return arrays


def assemble_trace(
    checkpoint: Checkpoint, episode: Episode, start: Gaussian, arrays: Mapping[str, Tensor], **provenance: Any
) -> Trace:
    """Build the trace of a run's arrays. That of a standalone run has only its modality, and no weights."""
    filter_ = checkpoint.filter
    si = filter_.statistics
    arrays = {
        **arrays,
        "start_mean": si.state_to_si(start.mean[0]),
        "start_covariance": si.covariance_to_si(start.covariance[0]),
    }
    modalities = filter_.names[: arrays["modality_mean"].shape[1]]
    if (only := provenance.get("settings", {}).get("standalone")) in modalities:
        k = modalities.index(only)
        modalities = modalities[k : k + 1]
        arrays = {name: values[:, k : k + 1] if name in BY_MODALITY else values for name, values in arrays.items()}
        arrays = {name: values for name, values in arrays.items() if name not in ("weights", "effective_weights")}
    return Trace(
        episode=episode,
        modalities=modalities,
        kind=checkpoint.kind,
        filter=checkpoint.name,
        checkpoint_hash=checkpoint.hash,
        **(provenance | {name: np.ascontiguousarray(value.numpy()) for name, value in arrays.items()}),
    )


BY_MODALITY = (
    *("modality_mean", "modality_covariance", "predicted_mean", "predicted_covariance"),
    *("observation_mean", "observation_covariance", "log_likelihood"),
)
"""Arrays (T, K, ...) of a trace, besides its weights."""


def _stack(filter_: Filter, beliefs: list[Gaussian]) -> tuple[Tensor, Tensor]:
    """Means (T, K, n) and covariances (T, K, n, n) in SI units of T banks with N = 1."""
    si = filter_.statistics
    mean = torch.cat([belief.mean for belief in beliefs])
    return si.state_to_si(mean), si.covariance_to_si(torch.cat([belief.covariance for belief in beliefs]))


def _ekf_arrays(filter_: Filter, steps: Sequence[StepTrace], evidence: Evidence) -> dict[str, Tensor]:
    assert isinstance(filter_, ExtendedKalmanFilter)
    predicted = [s.predicted for s in steps if isinstance(s.predicted, Gaussian)]
    modality = [s.modality for s in steps if s.modality is not None]
    arrays: dict[str, Tensor] = {}
    arrays["predicted_mean"], arrays["predicted_covariance"] = _stack(filter_, predicted)
    arrays["modality_mean"], arrays["modality_covariance"] = _stack(filter_, modality)
    arrays |= _sensor_arrays(filter_, evidence)
    if evidence.log_weights is not None:
        arrays["effective_weights"] = filter_.shares(evidence)[:, 0]
    elif len(filter_.names) > 1:
        information = torch.linalg.inv(torch.cat([belief.covariance for belief in modality]))
        fused = torch.cat([s.estimate.covariance for s in steps])
        shares = (fused.unsqueeze(1) @ information).diagonal(dim1=-2, dim2=-1)
        present = evidence.present
        arrays["effective_weights"] = (
            shares if present is None else shares * powers_of_present(present[:, 0])[..., None]
        )
    return arrays


def _sensor_arrays(filter_: ExtendedKalmanFilter, evidence: Evidence) -> dict[str, Tensor]:
    z = filter_.virtual_observations(evidence)
    mean, covariance = _stack(filter_, [Gaussian(z.mean[:, 0], z.covariance[:, 0])])
    return {"observation_mean": mean, "observation_covariance": covariance}


def _pf_arrays(filter_: Filter, steps: Sequence[StepTrace], evidence: Evidence) -> dict[str, Tensor]:
    predicted = [s.predicted for s in steps if isinstance(s.predicted, Particles)]
    states = torch.cat([p.states for p in predicted])
    prior = torch.cat([p.log_weights for p in predicted])
    posterior = torch.cat([s.posterior.log_weights for s in steps if isinstance(s.posterior, Particles)])
    log_likelihood = torch.cat([s.log_likelihood for s in steps if s.log_likelihood is not None])
    # All steps at once: faster than ``StepTrace.updates`` of each.
    modality = reweighted(Particles(states, prior), log_likelihood, filter_.angles)
    si = filter_.statistics
    arrays = {
        "particles": si.state_to_si(states),
        "prior_log_weights": prior,
        "log_weights": posterior,
        "log_likelihood": log_likelihood,
        "ancestors": torch.cat([s.ancestors for s in steps if s.ancestors is not None]).int(),
        "modality_mean": si.state_to_si(modality.mean),
        "modality_covariance": si.covariance_to_si(modality.covariance),
    }
    if isinstance(filter_, InformationFilter):
        return arrays | _sensor_arrays(filter_, evidence) | {"effective_weights": filter_.shares(evidence)[:, 0]}
    assert isinstance(filter_, MixtureParticleFilter)
    if len(filter_.names) == 1:
        return arrays
    scaled = log_likelihood - filter_.scale(prior, log_likelihood)
    if evidence.present is not None:
        scaled = only_present(scaled, evidence.present[:, 0])
    modality_evidence = torch.logsumexp(prior.unsqueeze(1) + scaled, dim=-1, keepdim=True)
    if evidence.log_weights is not None:
        modality_evidence = modality_evidence + evidence.log_weights[:, 0]
    arrays["effective_weights"] = torch.softmax(modality_evidence, dim=1)
    return arrays


def _sequence_arrays(filter_: Filter, steps: Sequence[StepTrace], evidence: Evidence) -> dict[str, Tensor]:
    none = torch.zeros(len(evidence), 0, filter_.n)
    return {"modality_mean": none, "modality_covariance": none.unsqueeze(-1).expand(-1, -1, -1, filter_.n)}


ARRAYS_OF: dict[Kind, Callable[[Filter, Sequence[StepTrace], Evidence], dict[str, Tensor]]] = {
    "ekf": _ekf_arrays,
    "ukf": _ekf_arrays,
    "pf": _pf_arrays,
    "lstm": _sequence_arrays,
    "transformer": _sequence_arrays,
}
"""Kind of filter -> function that converts its steps to trace arrays."""

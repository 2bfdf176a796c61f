"""Particle health: effective sample size, ancestry, modes, and whether the particles cover the true state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from beliefscope.datasets.covariate import in_phase
from beliefscope.datasets.text import percent, plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.covariance_floor import with_floor
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.ensemble import has_equal_weights
from beliefscope.inspect.diagnostics.healthy_comparison import Comparison
from beliefscope.inspect.diagnostics.views import Curve, Table
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.calibration import particle_level
from beliefscope.inspect.statistics.measures import Array, Mask
from beliefscope.inspect.trace import Trace

DEGENERATE = 0.1
"""Ratio of effective sample size to particles below which a particle set is degenerate."""

OUTSIDE = 1e-6
"""Share of predicted weight farther than the true state below which this is outside of all particles: rounding."""

CELLS, EDGE = 64, 4.0
"""Density grid: cells per side, and extent in standard deviations from the mean."""
HEIGHTS = (0.1, 0.25, 0.5)
"""Fractions of the maximum density at which modes are separated."""
MIN_WEIGHT = 0.1
"""Minimum share of the total weight in a mode."""


@dataclass(frozen=True)
class ParticleSteps:
    """Particle measures by step of one trace.

    Attributes:
        effective: (T,) effective sample size ``1 / sum w^2`` of the posterior weights.
        largest: (T,) largest posterior weight.
        ancestors: (T,) number of particles with offspring.
        resampled: (T,) whether any particle was replaced.
        evidence: (T, K) ``log sum_i w_i p_k(z | x_i)`` under the prior weights in nats, up to a constant per model; NaN
            if likelihoods are not available.
        modes: (T,) number of modes of the posterior over the map components.
        farther: (T,) share of predicted weight that is farther from the mean than the true state (Mahalanobis); 0 if
            the true state is outside of all particles, NaN where it is unknown.
        contact, blackout: (T,) phases.
    """

    effective: Array
    largest: Array
    ancestors: NDArray[np.int64]
    resampled: Mask
    evidence: Array
    modes: NDArray[np.int64]
    farther: Array
    contact: Mask
    blackout: Mask


@dataclass(frozen=True)
class PhaseParticles:
    """Particle measures of one phase.

    Attributes:
        phase, steps: phase name and number of steps.
        effective, ancestors, largest: medians.
        smallest: smallest effective sample size.
        degenerate, resampled, several_modes, outside: share of steps with a degenerate set, with resampling, with
            several modes, and with the true state outside of all particles, NaN if it is unknown.
        evidence: (K,) mean.
    """

    phase: str
    steps: int
    effective: float
    smallest: float
    ancestors: float
    largest: float
    degenerate: float
    resampled: float
    several_modes: float
    outside: float
    evidence: Array


@dataclass(frozen=True)
class ParticleHealth(Diagnostic):
    """Result of ``particle_health``.

    Attributes:
        filter, modalities, particles: filter name, K modality names, M.
        trajectories: number of traces.
        phases: measures by phase.
        steps: measures by step of a single trace; None for several.
        worst_episode, worst_step: episode and step with the smallest effective sample size.
        worst: measures of that step.
        healthy: comparison with the filter's healthy record, if it has one.
    """

    filter: str
    modalities: tuple[str, ...]
    particles: int
    trajectories: int
    phases: tuple[PhaseParticles, ...]
    steps: ParticleSteps | None
    worst_episode: int
    worst_step: int
    worst: ParticleSteps
    healthy: Comparison | None = None

    @property
    def alarms(self) -> tuple[str, ...]:
        return () if self.healthy is None else tuple(alarm.text for alarm in self.healthy.alarms)

    @property
    def verdict(self) -> str:
        total, worst, count = self.phases[0], self.worst, self.particles
        frequency = f"below {percent(DEGENERATE)} of {count} particles in {percent(total.degenerate, '.1f')} of steps"
        if not total.degenerate:
            frequency = f"never below {percent(DEGENERATE)} of {count} particles"
        conditions = [phase for phase in ("contact", "blackout") if getattr(worst, phase)[0]]
        where = f"step {self.worst_step} of episode {self.worst_episode}" + (
            f", in {' and '.join(conditions)}" if conditions else ""
        )
        parts = [] if self.healthy is None else [self.healthy.sentence]
        parts += [
            f"The effective sample size is {frequency}, with a median of {total.effective:.0f}.",
            f"Minimum at {where}: effective sample size {worst.effective[0]:.1f}, largest weight "
            f"{worst.largest[0]:.2f}, {plural(worst.ancestors[0], 'particle')} with offspring.",
        ]
        phases = [entry for entry in self.phases[1:] if entry.degenerate > 1.5 * total.degenerate > 0.0]
        if phases:
            most = max(phases, key=lambda entry: entry.degenerate)
            where = in_phase(most.phase, {})
            parts.append(f"Degeneracy is most frequent {where}: {percent(most.degenerate, '.1f')} of steps.")
        if total.outside > 0.0:
            share = percent(total.outside, ".1f")
            parts.append(f"The true state is outside of all predicted particles in {share} of steps.")
        elif total.outside == 0.0:
            parts.append("The true state is always covered by the predicted particles.")
        if total.several_modes:
            parts.append(f"The posterior is multimodal in {percent(total.several_modes, '.1f')} of steps.")
        return " ".join(parts)

    def tables(self) -> list[Table]:
        evidence = [f"evidence of {modality} (nats)" for modality in self.modalities]
        rows = [
            {
                "phase": entry.phase,
                "steps": entry.steps,
                "ESS (median)": entry.effective,
                "ESS (minimum)": entry.smallest,
                f"ESS below {percent(DEGENERATE)} (% of steps)": 100.0 * entry.degenerate,
                "largest weight (median)": entry.largest,
                "with offspring (median)": entry.ancestors,
                "resampled (% of steps)": 100.0 * entry.resampled,
                "multimodal (% of steps)": 100.0 * entry.several_modes,
                "true state outside (% of steps)": 100.0 * entry.outside,
                **dict(zip(evidence, entry.evidence, strict=True)),
            }
            for entry in self.phases
        ]
        tables = [Table.from_rows(f"Particle health, {plural(self.particles, 'particle')}", rows)]
        return tables if self.healthy is None else [*tables, self.healthy.table()]

    def curves(self) -> list[Curve]:
        if self.steps is None:
            return []
        steps, bounds = self.steps, (DEGENERATE * self.particles, float(self.particles))
        curves = [
            Curve("effective sample size", steps.effective, "Particles", "particles", "fused", bounds),
            Curve("with offspring", steps.ancestors.astype(float), "Particles", "particles"),
            Curve("largest weight", steps.largest, "Weights", "", "fused"),
            Curve("predicted weight farther than the true state", steps.farther, "Weights", "", "truth"),
            Curve("modes", steps.modes.astype(float), "Modes of the posterior", "", "fused"),
        ]
        return curves + [
            Curve(f"{modality} evidence", steps.evidence[:, k], "Evidence", "nats", modality)
            for k, modality in enumerate(self.modalities)
        ]

    def bands(self) -> dict[str, Mask]:
        return {} if self.steps is None else {"contact": self.steps.contact, "blackout": self.steps.blackout}


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if trace.particles is None or trace.log_weights is None:
        return f"filter {trace.filter} has no particles"
    if trace.all_particles_ess is not None:
        kept, total = trace.particles.shape[1], trace.particle_count
        return f"the trace has {kept} of {total} particles; trace with --particles-kept {total}"
    if trace.ancestors is None and trace.prior_log_weights is None and has_equal_weights(trace):
        return f"all particles of {trace.filter} have the same weight in every step: see the diagnostic Ensemble"
    return None


def particle_health(traces: Sequence[Trace], healthy: Comparison | None = None) -> ParticleHealth:
    """Evaluate the particle health of one filter over one or more episodes."""
    first = traces[0]
    assert first.particles is not None
    measured = [measure_steps(trace) for trace in traces]
    pooled = {f.name: np.concatenate([getattr(steps, f.name) for steps in measured]) for f in fields(ParticleSteps)}
    masks = measures.pooled_phases(traces)
    count = first.particles.shape[1]
    phases = []
    for phase, where in masks.items():
        if where.any():
            phases.append(_summarise(phase, count, {name: values[where] for name, values in pooled.items()}))
    at = int(np.where(masks["all"], pooled["effective"], np.inf).argmin())
    index = measures.trace_indices(traces)[at]
    return ParticleHealth(
        filter=first.filter,
        modalities=first.modalities,
        particles=count,
        trajectories=len(traces),
        phases=tuple(phases),
        steps=measured[0] if len(traces) == 1 else None,
        worst_episode=traces[index].episode_index,
        worst_step=at - sum(len(trace) for trace in traces[:index]),
        worst=ParticleSteps(**{name: values[at : at + 1] for name, values in pooled.items()}),
        healthy=healthy,
    )


def trajectory_statistics(trace: Trace) -> dict[str, float]:
    """Statistics of a healthy profile: mean relative effective sample size, and how often the truth is outside."""
    assert trace.log_weights is not None
    effective = 1.0 / np.exp(2.0 * trace.log_weights.astype(np.float64)).sum(1) / trace.log_weights.shape[1]
    phases = measures.long_phases(trace)
    values = {f"ess//{phase}": float(effective[mask].mean()) for phase, mask in phases.items()}
    if "all" in phases:
        prior = trace.prior_log_weights
        weights = np.full(trace.log_weights.shape, 1.0) if prior is None else np.exp(prior.astype(np.float64))
        farther = _farther(trace, weights / weights.sum(1, keepdims=True))
        values["outside//all"] = _outside(farther[phases["all"]])
    return {name: value for name, value in values.items() if math.isfinite(value)}


def measure_steps(trace: Trace) -> ParticleSteps:
    """Compute the measures of all steps of a trace."""
    assert trace.particles is not None
    assert trace.log_weights is not None
    task = trace.task
    steps, count, _ = trace.particles.shape
    weights = np.exp(trace.log_weights.astype(np.float64))
    prior = trace.prior_log_weights
    prior = np.full((steps, count), -np.log(count)) if prior is None else prior.astype(np.float64)
    evidence = np.full((steps, len(trace.modalities)), np.nan)
    if trace.log_likelihood is not None:
        evidence = np.logaddexp.reduce(prior[:, None] + trace.log_likelihood, axis=-1)
    indices = np.arange(count)
    ancestors = np.broadcast_to(indices, (steps, count)) if trace.ancestors is None else trace.ancestors
    points = trace.task.near(trace.particles, trace.estimate_mean[:, None])[..., list(task.map_indices)].astype(
        np.float64
    )
    points = np.pad(points, ((0, 0), (0, 0), (0, 2 - points.shape[-1])))  # a map of one component has no second
    return ParticleSteps(
        effective=1.0 / np.square(weights).sum(1),
        largest=weights.max(1),
        ancestors=1 + (np.diff(np.sort(ancestors, axis=1), axis=1) != 0).sum(1),
        resampled=(ancestors != indices).any(1),
        evidence=evidence,
        modes=modes(points, weights),
        farther=_farther(trace, np.exp(prior)),
        contact=trace.episode.contact.astype(bool),
        blackout=measures.blackout(trace),
    )


def modes(points: Array, weights: Array) -> NDArray[np.int64]:
    """(T,) number of modes of weighted particles (T, M, 2) with weights (T, M), at least one.

    The density is whitened by the covariance of the particles and smoothed by a Gaussian kernel of Silverman's width
    ``ESS^(-1/6)`` standard deviations. Modes are connected regions above a fraction of the maximum with at least
    ``MIN_WEIGHT`` of the weight; the largest number over ``HEIGHTS`` counts. For 300 particles in two equal
    clusters, half of the sets are separated at a distance of 4.5 cluster standard deviations, 90 % at 5.
    """
    steps = len(weights)
    deviation = points - (weights[..., None] * points).sum(1, keepdims=True)
    covariance = with_floor(np.einsum("tm,tmi,tmj->tij", weights, deviation, deviation))
    white = np.swapaxes(np.linalg.solve(np.linalg.cholesky(covariance), np.swapaxes(deviation, 1, 2)), 1, 2)
    cells = np.floor((white + EDGE) * (CELLS / (2.0 * EDGE))).astype(np.int64)
    inside = ((cells >= 0) & (cells < CELLS)).all(-1)
    at = np.arange(steps)[:, None] * CELLS**2 + cells[..., 0] * CELLS + cells[..., 1]
    histogram = np.bincount(at[inside], weights[inside], steps * CELLS**2).reshape(steps, CELLS, CELLS)
    centres = (np.arange(CELLS) + 0.5) * (2.0 * EDGE / CELLS)
    width = np.square(weights).sum(1)[:, None, None] ** (1.0 / 6.0)
    kernel = np.exp(-0.5 * np.square((centres[:, None] - centres) / width))
    density = kernel @ histogram @ kernel
    density /= density.sum((1, 2), keepdims=True)
    return np.max([_regions(density, height) for height in HEIGHTS], axis=0).clip(1)


def _regions(density: Array, height: float) -> NDArray[np.int64]:
    """(T,) number of connected regions of a density (T, S, S) above a fraction of its maximum, with enough weight."""
    neighbours = np.zeros((3, 3, 3), dtype=bool)
    neighbours[1] = True  # regions do not extend across steps
    labels, count = label(density >= height * density.max((1, 2), keepdims=True), neighbours)
    step = np.zeros(count + 1, dtype=np.int64)
    step[labels.ravel()] = np.repeat(np.arange(len(density)), density[0].size)
    weight = np.bincount(labels.ravel(), density.ravel(), count + 1)
    return np.bincount(step[1:][weight[1:] >= MIN_WEIGHT], minlength=len(density))


def _outside(farther: Array) -> float:
    """Share of the steps with a known true state at which this is outside of all particles; NaN without any."""
    return measures.known_mean(np.where(np.isnan(farther), np.nan, farther < OUTSIDE))


def _farther(trace: Trace, weights: Array) -> Array:
    """(T,) share of the predicted weight (T, M) farther from the mean than the known part of the true state."""
    assert trace.particles is not None
    task, known = trace.task, measures.known_components(trace)
    if not known:
        return np.full(len(trace), np.nan)
    deviation = task.difference(trace.particles, trace.episode.states[:, None])
    error = (weights[..., None] * deviation).sum(1)
    from_mean = measures.wrapped(task, deviation - error[:, None])[..., known]
    covariance = with_floor(np.einsum("tm,tmi,tmj->tij", weights, from_mean, from_mean))
    level = particle_level(from_mean, weights, error[:, known], covariance)
    return np.where(np.isfinite(error[:, known]).all(-1), 1.0 - level, np.nan)


def _summarise(phase: str, count: int, steps: dict[str, Array]) -> PhaseParticles:
    effective = steps["effective"]
    return PhaseParticles(
        phase=phase,
        steps=len(effective),
        effective=float(np.median(effective)),
        smallest=float(effective.min()),
        ancestors=float(np.median(steps["ancestors"])),
        largest=float(np.median(steps["largest"])),
        degenerate=float((effective < DEGENERATE * count).mean()),
        resampled=float(steps["resampled"].mean()),
        several_modes=float((steps["modes"] > 1).mean()),
        outside=_outside(steps["farther"]),
        evidence=steps["evidence"].mean(0),
    )


ENTRY = Entry(
    name="particles",
    title="Particle health",
    question="Do enough particles represent the belief, and do they cover the true state?",
    run=particle_health,
    why_not=why_not,
    statistics=trajectory_statistics,
)

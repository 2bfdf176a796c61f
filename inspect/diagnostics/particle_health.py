"""Particle health: how many particles carry the belief, where they come from, and whether the truth is among them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Curve, Diagnostic, Entry, Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.calibration import particle_level
from beliefscope.inspect.trace import Trace

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEW = 0.1
"""Effective share of the particles below which a set counts as degenerate."""

CELLS, EDGE = 64, 4.0
"""Of the density's grid: cells a side, and where it ends, in standard deviations from the mean."""
HEIGHTS = (0.1, 0.25, 0.5)
"""Shares of the highest density at which modes may part."""
LEAST = 0.1
"""Share of all weight that a region must hold to be a mode."""


@dataclass(frozen=True)
class ParticleSteps:
    """By step of one trace.

    Attributes:
        effective: (T,) effective sample size ``1 / sum w^2`` of the posterior weights. largest: (T,) largest of them.
        ancestors: (T,) how many particles have offspring. resampled: (T,) whether any was replaced.
        evidence: (T, K) ``log sum_i w_i p_k(z | x_i)`` under the prior weights, as the model gives p_k: nats, up to a
            constant of each model. NaN where likelihoods are not known.
        modes: (T,) of the posterior on the map's plane (``modes``).
        farther: (T,) share of the predicted weight that is farther from its mean than the truth (Mahalanobis): 0 where
            the truth is outside of all particles.
        contact, blackout: (T,) its steps.
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
class SplitParticles:
    """Over one kind of step: medians of effective sample size, ancestors and largest weight, the smallest effective
    sample size; the shares of steps that are degenerate (below ``FEW``), resampled, of several modes, and with the
    truth outside of all particles; mean evidence (K,)."""

    split: str
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
    """Result of ``particles``.

    Attributes:
        filter, modalities, particles: its name, K names, M. trajectories: how many traces.
        splits: by kind of step. lone: the steps of a lone trace; None of several.
        worst_episode, worst_step: where the effective sample size is smallest. worst: of that one step.
    """

    filter: str
    modalities: tuple[str, ...]
    particles: int
    trajectories: int
    splits: tuple[SplitParticles, ...]
    lone: ParticleSteps | None
    worst_episode: int
    worst_step: int
    worst: ParticleSteps

    @property
    def verdict(self) -> str:
        whole, worst, count = self.splits[0], self.worst, self.particles
        often = f"below {FEW:.0%} of {count} particles in {whole.degenerate:.1%} of steps"
        if not whole.degenerate:
            often = f"never below {FEW:.0%} of {count} particles"
        when = [kind for kind in ("contact", "blackout") if getattr(worst, kind)[0]]
        where = f"step {self.worst_step} of episode {self.worst_episode}" + (
            f", in {' and '.join(when)}" if when else ""
        )
        parts = [
            f"The effective sample size is {often}, {whole.effective:.0f} in the median.",
            f"Worst at {where}: {worst.effective[0]:.1f} effective, the largest weight {worst.largest[0]:.2f}, "
            f"{worst.ancestors[0]} with offspring.",
        ]
        kinds = [one for one in self.splits[1:] if one.degenerate > 1.5 * whole.degenerate > 0.0]
        if kinds:
            most = max(kinds, key=lambda one: one.degenerate)
            parts.append(f"It happens most in {most.split}: {most.degenerate:.1%} of steps.")
        outside = (
            f"lies outside all predicted particles in {whole.outside:.1%} of steps, where no weights could find it"
        )
        parts.append(f"The truth {outside if whole.outside else 'is always among the predicted particles'}.")
        if whole.several_modes:
            parts.append(f"The posterior has several modes in {whole.several_modes:.1%} of steps.")
        return " ".join(parts)

    def tables(self) -> list[Table]:
        rows: list[tuple[Value, ...]] = [
            (
                one.split,
                one.steps,
                one.effective,
                one.smallest,
                100.0 * one.degenerate,
                one.largest,
                one.ancestors,
                100.0 * one.resampled,
                100.0 * one.several_modes,
                100.0 * one.outside,
                *map(float, one.evidence),
            )
            for one in self.splits
        ]
        columns = (
            "steps",
            "count",
            "ESS (median)",
            "ESS (least)",
            f"ESS below {FEW:.0%} (% of steps)",
            "largest weight (median)",
            "with offspring (median)",
            "resampled (% of steps)",
            "several modes (% of steps)",
            "truth outside (% of steps)",
            *(f"evidence of {modality} (nats)" for modality in self.modalities),
        )
        return [Table(f"Particle health, {self.particles} particles", columns, tuple(rows))]

    def curves(self) -> list[Curve]:
        if self.lone is None:
            return []
        steps, bounds = self.lone, (FEW * self.particles, float(self.particles))
        curves = [
            Curve("effective sample size", steps.effective, "Particles", "particles", "fused", bounds),
            Curve("with offspring", steps.ancestors.astype(float), "Particles", "particles"),
            Curve("largest weight", steps.largest, "Shares", "", "fused"),
            Curve("predicted weight farther than the truth", steps.farther, "Shares", "", "truth"),
            Curve("modes", steps.modes.astype(float), "Modes of the posterior", "", "fused"),
        ]
        return curves + [
            Curve(f"{modality} evidence", steps.evidence[:, k], "Evidence", "nats", modality)
            for k, modality in enumerate(self.modalities)
        ]

    def bands(self) -> dict[str, Mask]:
        return {} if self.lone is None else {"contact": self.lone.contact, "blackout": self.lone.blackout}


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """In one line; None where it can be made."""
    if trace.particles is None or trace.log_weights is None:
        return f"{trace.filter} has no particles"
    return None


def particle_health(traces: Sequence[Trace]) -> ParticleHealth:
    """Particle health of one filter, over one or several trajectories."""
    first = traces[0]
    assert first.particles is not None
    made = [of_trace(trace) for trace in traces]
    pooled = {f.name: np.concatenate([getattr(one, f.name) for one in made]) for f in fields(ParticleSteps)}
    masks = measures.pooled_splits(traces)
    count = first.particles.shape[1]
    splits = []
    for split, where in masks.items():
        if where.any():
            splits.append(_of_steps(split, count, {name: values[where] for name, values in pooled.items()}))
    at = int(np.where(masks["all"], pooled["effective"], np.inf).argmin())
    owner = measures.owners(traces)[at]
    return ParticleHealth(
        filter=first.filter,
        modalities=first.modalities,
        particles=count,
        trajectories=len(traces),
        splits=tuple(splits),
        lone=made[0] if len(traces) == 1 else None,
        worst_episode=traces[owner].episode_index,
        worst_step=at - sum(len(trace) for trace in traces[:owner]),
        worst=ParticleSteps(**{name: values[at : at + 1] for name, values in pooled.items()}),
    )


def of_trace(trace: Trace) -> ParticleSteps:
    """Its steps."""
    assert trace.particles is not None
    assert trace.log_weights is not None
    task = measures.task_of(trace)
    steps, count, _ = trace.particles.shape
    weights = np.exp(trace.log_weights.astype(np.float64))
    prior = trace.prior_log_weights
    prior = np.full((steps, count), -np.log(count)) if prior is None else prior.astype(np.float64)
    evidence = np.full((steps, len(trace.modalities)), np.nan)
    if trace.log_likelihood is not None:
        evidence = np.logaddexp.reduce(prior[:, None] + trace.log_likelihood, axis=-1)
    own = np.arange(count)
    ancestors = np.broadcast_to(own, (steps, count)) if trace.ancestors is None else trace.ancestors
    where = list(task.map_indices)
    return ParticleSteps(
        effective=1.0 / np.square(weights).sum(1),
        largest=weights.max(1),
        ancestors=1 + (np.diff(np.sort(ancestors, axis=1), axis=1) != 0).sum(1),
        resampled=(ancestors != own).any(1),
        evidence=evidence,
        modes=modes(trace.particles[..., where].astype(np.float64), weights),
        farther=_farther(trace, np.exp(prior)),
        contact=trace.episode.contact.astype(bool),
        blackout=measures.blackout(trace),
    )


def modes(points: Array, weights: Array) -> NDArray[np.int64]:
    """(T,) how many modes weighted particles (T, M, 2) with weights (T, M) have, from one on.

    The density is smoothed over the cloud, whitened by its own covariance, with a Gaussian kernel of Silverman's width
    ``ESS^(-1/6)`` standard deviations. Modes are the connected regions above a share of its peak that hold at least
    ``LEAST`` of its weight; the height at which most of them part counts (``HEIGHTS``). Of 300
    particles in two equal clouds half of the sets part at 4.5 of their own standard deviations, nine of ten at 5.
    """
    steps = len(weights)
    away = points - (weights[..., None] * points).sum(1, keepdims=True)
    covariance = np.einsum("tm,tmi,tmj->tij", weights, away, away) + measures.FLOOR * np.eye(2)
    white = np.swapaxes(np.linalg.solve(np.linalg.cholesky(covariance), np.swapaxes(away, 1, 2)), 1, 2)
    cells = np.floor((white + EDGE) * (CELLS / (2.0 * EDGE))).astype(np.int64)
    inside = ((cells >= 0) & (cells < CELLS)).all(-1)
    at = np.arange(steps)[:, None] * CELLS**2 + cells[..., 0] * CELLS + cells[..., 1]
    drawn = np.bincount(at[inside], weights[inside], steps * CELLS**2).reshape(steps, CELLS, CELLS)
    centres = (np.arange(CELLS) + 0.5) * (2.0 * EDGE / CELLS)
    width = np.square(weights).sum(1)[:, None, None] ** (1.0 / 6.0)
    kernel = np.exp(-0.5 * np.square((centres[:, None] - centres) / width))
    density = kernel @ drawn @ kernel
    density /= density.sum((1, 2), keepdims=True)
    return np.max([_regions(density, height) for height in HEIGHTS], axis=0).clip(1)


def _regions(density: Array, height: float) -> NDArray[np.int64]:
    """(T,) connected regions of each step's density (T, S, S) above a share of its peak, with enough weight."""
    neighbours = np.zeros((3, 3, 3), dtype=bool)
    neighbours[1] = True  # steps do not touch one another
    labels, found = label(density >= height * density.max((1, 2), keepdims=True), neighbours)
    step = np.zeros(found + 1, dtype=np.int64)
    step[labels.ravel()] = np.repeat(np.arange(len(density)), density[0].size)
    weight = np.bincount(labels.ravel(), density.ravel(), found + 1)
    return np.bincount(step[1:][weight[1:] >= LEAST], minlength=len(density))


def _farther(trace: Trace, weights: Array) -> Array:
    """(T,) share of the predicted particles' weight (T, M) that is farther from their mean than the truth is."""
    assert trace.particles is not None
    task = measures.task_of(trace)
    away = measures.wrapped(task, trace.particles - trace.episode.states[:, None])
    error = (weights[..., None] * away).sum(1)
    from_mean = measures.wrapped(task, away - error[:, None])
    covariance = np.einsum("tm,tmi,tmj->tij", weights, from_mean, from_mean)
    return 1.0 - particle_level(from_mean, weights, error, covariance + measures.FLOOR * np.eye(error.shape[-1]))


def _of_steps(split: str, count: int, steps: dict[str, Array]) -> SplitParticles:
    effective = steps["effective"]
    return SplitParticles(
        split=split,
        steps=len(effective),
        effective=float(np.median(effective)),
        smallest=float(effective.min()),
        ancestors=float(np.median(steps["ancestors"])),
        largest=float(np.median(steps["largest"])),
        degenerate=float((effective < FEW * count).mean()),
        resampled=float(steps["resampled"].mean()),
        several_modes=float((steps["modes"] > 1).mean()),
        # Weights sum to one but for rounding.
        outside=float((steps["farther"] < 1e-6).mean()),
        evidence=steps["evidence"].mean(0),
    )


ENTRY = Entry(
    name="particles",
    title="Particle health",
    question="Do enough particles carry the belief, and is the truth among them?",
    run=particle_health,
    why_not=why_not,
)

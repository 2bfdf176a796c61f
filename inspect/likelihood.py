"""Likelihood maps: likelihood or posterior of every position of the map square, by modality, at one step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.models.fusion import mixture
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.inspect.maps.fusion_rules import fuse_sensors, fusion_rule
from beliefscope.inspect.maps.grid import GridEvaluator, one_thread
from beliefscope.inspect.maps.likelihood_map import QUANTITIES, Array, LikelihoodMap, Quantity
from beliefscope.inspect.maps.particle_density import ParticleDensity
from beliefscope.inspect.statistics.measures import FLOOR, wrapped
from beliefscope.inspect.trace import Trace

__all__ = [
    "COARSE",
    "FINE",
    "LARGEST",
    "QUANTITIES",
    "LikelihoodMap",
    "MapEngine",
    "Quantity",
    "missing_quantities",
    "no_maps",
]

COARSE, FINE = 41, 135
"""Cells per side: maps during scrubbing and of all steps; maps of a single step."""

LARGEST = 1024
"""Maximum number of cells per side."""


def no_maps(checkpoint: Checkpoint, trace: Trace | None = None, quantity: Quantity | None = None) -> str | None:
    """One-line reason why a filter has no maps of a quantity, or None.

    Args:
        trace: a trace of the filter; required for an external filter, whose maps are computed from its Gaussians.
        quantity: by default either.
    """
    task, subject = checkpoint.task, "has no likelihood maps" if quantity != "posterior" else "has no posterior maps"
    if trace is not None and (only := trace.settings.get("standalone")):
        return f"a standalone run of {only} {subject}: those of the run with all modalities include {only}"
    if isinstance(checkpoint, ExternalFilter):
        reasons = [_no_gaussians(trace, each) for each in ((quantity,) if quantity else QUANTITIES)]
        if None not in reasons:
            return f"filter {checkpoint.name!r} {subject}: {reasons[-1]}"
    elif not checkpoint.filter.has_covariance:
        kind = {"lstm": "an LSTM"}.get(checkpoint.kind, f"a {checkpoint.kind}")
        return f"filter {checkpoint.name!r} {subject}: {kind} has no likelihood and no covariance"
    off_map = [c.name for i, c in enumerate(task.components) if i not in task.map_indices]
    if len(off_map) > 1:
        return f"task {task.name!r} {subject}: {', '.join(off_map)} are not on the map; at most one can be held fixed"
    return None


def missing_quantities(checkpoint: Checkpoint, trace: Trace) -> dict[Quantity, str]:
    """Quantities without maps of this filter, with the reasons (``no_maps``)."""
    reasons = {quantity: no_maps(checkpoint, trace, quantity) for quantity in QUANTITIES}
    return {quantity: reason for quantity, reason in reasons.items() if reason is not None}


def _no_gaussians(trace: Trace | None, quantity: Quantity) -> str | None:
    """Reason why an external filter has no Gaussians of a quantity to draw, or None."""
    if trace is None or not trace.has_covariance:
        return "it reports no covariance"
    if trace.log_likelihood is not None or trace.particles is not None:
        return "its measurement model is known only at its particles"
    if quantity == "likelihood":
        if trace.observation_mean is None or trace.observation_covariance is None:
            return "it reports no virtual observations (observation_mean and observation_covariance)"
        covariances = trace.observation_covariance
    else:
        if trace.modalities and not trace.modalities_with_posterior:
            return "it reports no single-modality updates"
        covariances = np.concatenate([trace.modality_covariance, trace.estimate_covariance[:, None]], axis=1)
    degenerate = np.linalg.eigvalsh(covariances.astype(np.float64)).min(axis=(1, 2)) <= 0.0
    return f"a covariance of step {int(degenerate.argmax())} is not positive definite" if degenerate.any() else None


class MapEngine:
    """Computes the maps of one trace, reusing values that cells or steps share.

    Observations are encoded for all steps at once; ``GridEvaluator`` reuses values that depend on the grid.
    """

    def __init__(self, checkpoint: Checkpoint, trace: Trace) -> None:
        """Raises BadInput if the filter has no maps (``no_maps``), or if the trace is from another checkpoint."""
        if why := no_maps(checkpoint, trace):
            raise BadInput(why)
        if trace.checkpoint_hash != checkpoint.hash:
            raise BadInput(
                f"the trace is from checkpoint {trace.checkpoint_hash[:12]}, not from {checkpoint.hash[:12]}"
            )
        self.checkpoint = checkpoint
        self.trace = trace
        self.task = checkpoint.task
        self.evidence = self._encode()
        off_map = [i for i in range(len(self.task.components)) if i not in self.task.map_indices]
        self.fixed = off_map[0] if off_map else None
        self._grid = self._grid_evaluator()
        self._anchors = trace.anchors
        missing = missing_quantities(checkpoint, trace)
        self.quantities = tuple(quantity for quantity in QUANTITIES if quantity not in missing)

    @torch.no_grad()
    def _encode(self) -> Evidence | None:
        if isinstance(self.checkpoint, ExternalFilter):
            return None
        filter_ = self.checkpoint.filter
        if not isinstance(filter_, MixtureParticleFilter):
            return None
        return filter_.encode(Steps.from_episodes(self.task, [self.trace.episode]).episode(0))

    def _grid_evaluator(self) -> GridEvaluator | None:
        if self.evidence is None:
            return None
        filter_ = self.checkpoint.filter
        assert isinstance(filter_, MixtureParticleFilter)
        models = [filter_.measurement_model(name) for name in filter_.names]
        return GridEvaluator(models, self.task.map_indices, filter_.statistics.mean_std("state")[1])

    @torch.no_grad()
    def map(
        self, step: int, angle: float | None = None, size: int = FINE, quantity: Quantity | None = None
    ) -> LikelihoodMap:
        """Compute the maps of one step.

        Args:
            angle: rad, value of the component that is not on the map; by default the true value.
            size: cells per side, S.
            quantity: by default the likelihood, or the posterior for a filter that reports only that (``quantities``).

        Raises:
            BadInput: step, angle or size out of range, or the filter does not have the quantity.
        """
        quantity = quantity or self.quantities[0]
        if quantity not in QUANTITIES:
            raise unknown_name("quantity of a map", quantity, QUANTITIES)
        if quantity not in self.quantities:
            raise BadInput(no_maps(self.checkpoint, self.trace, quantity) or "")
        trace = self.trace
        if not 0 <= step < len(trace):
            raise BadInput(f"step {step} is not in this episode: it has steps 0 to {len(trace) - 1}")
        if not 2 <= size <= LARGEST:
            raise BadInput(f"a map has 2 to {LARGEST} cells per side, not {size}")
        if angle is not None and not math.isfinite(angle):
            raise BadInput(f"angle must be a finite number of rad, not {angle}")
        anchor = self._anchors[step]
        middle, centre = anchor.astype(np.float64), anchor[list(self.task.map_indices)]
        if self.fixed is not None and angle is not None:
            middle[self.fixed] = angle
        with one_thread():
            evaluate = self._particle_filter if self.evidence is not None else self._gaussians
            values = evaluate(step, size, middle, quantity)
        return LikelihoodMap(
            step=step,
            angle=math.nan if self.fixed is None else float(middle[self.fixed]),
            layers=(*trace.modalities, "fused"),
            offsets_x=self._offsets(size),
            offsets_y=self._offsets(size),
            centre=centre,
            log_likelihood=values,
            quantity=quantity,
            rule=fusion_rule(self.checkpoint, trace.modalities, quantity),
        )

    def maps(
        self,
        steps: Sequence[int],
        size: int = FINE,
        progress: Callable[[float], None] | None = None,
        quantity: Quantity | None = None,
    ) -> Iterator[LikelihoodMap]:
        """Maps of several steps, at the true angle. ``progress`` is called with the completed fraction, 0..1."""
        for count, step in enumerate(steps, start=1):
            yield self.map(step, size=size, quantity=quantity)
            if progress is not None:
                progress(count / len(steps))

    def _offsets(self, size: int) -> Array:
        """(S,) m, cell centres."""
        offsets = ((np.arange(size) + 0.5) / size * 2.0 - 1.0) * self.task.map_half_width
        return offsets.astype(np.float32)

    def _particle_filter(self, step: int, size: int, middle: NDArray[np.float64], quantity: Quantity) -> Array:
        """(K + 1, S, S) log-likelihoods of the measurement models and of the fused mixture, or log posteriors.

        The posterior is ``p(x) p(z | x) / p(z)``: the prior p(x) is the density of the predicted particles, and the
        evidence p(z) the mean likelihood of the particles under their prior weights.
        """
        filter_, trace = self.checkpoint.filter, self.trace
        assert isinstance(filter_, MixtureParticleFilter)
        assert self.evidence is not None
        evidence = self.evidence[step]
        assert self._grid is not None
        unimodal = self._grid.log_likelihood(
            torch.from_numpy(self._offsets(size)),
            filter_.statistics.standardise("state", torch.from_numpy(middle)),
            tuple(middle.tolist()),
            evidence.observation[0],
        )
        assert trace.prior_log_weights is not None
        assert trace.log_likelihood is not None
        prior, particle_likelihood = trace.prior_log_weights[step], trace.log_likelihood[step]
        scale = filter_.scale(torch.from_numpy(prior)[None], torch.from_numpy(particle_likelihood)[None])[0]
        # The trace's weights: they may have been edited.
        log_weights = None if trace.weights is None else torch.from_numpy(trace.weights[step]).log()
        values = torch.cat([unimodal, mixture(unimodal - scale, log_weights).unsqueeze(0)])
        if quantity == "posterior":
            assert trace.particles is not None
            at_particles = torch.from_numpy(particle_likelihood)
            at_particles = torch.cat([at_particles, mixture(at_particles - scale, log_weights).unsqueeze(0)])
            evidence_ = torch.logsumexp(torch.from_numpy(prior) + at_particles, dim=1, keepdim=True)
            density = ParticleDensity(self.task, trace.particles[step], prior)
            log_prior = density.log_density(middle, self._offsets(size).astype(np.float64)).astype(np.float32)
            values = values - evidence_ + torch.from_numpy(log_prior).flatten()
        return values.unflatten(1, (size, size)).numpy()

    def _moments(self, step: int, quantity: Quantity) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Means (K + 1, n) and covariances (K + 1, n, n) of the sensors or posteriors, the fused one last."""
        trace = self.trace
        if quantity == "posterior":
            mean = np.concatenate([trace.modality_mean[step], trace.estimate_mean[step][None]])
            covariance = np.concatenate([trace.modality_covariance[step], trace.estimate_covariance[step][None]])
            floor = 0.0 if trace.particles is None else FLOOR  # the weights may be concentrated on one particle
            return mean.astype(np.float64), covariance.astype(np.float64) + floor * np.eye(mean.shape[-1])
        assert trace.observation_mean is not None
        assert trace.observation_covariance is not None
        sensors, noise = trace.observation_mean[step], trace.observation_covariance[step]
        z, r = sensors.astype(np.float64), noise.astype(np.float64)
        fused = fuse_sensors(self.checkpoint, z, r, None if trace.weights is None else trace.weights[step])
        return np.concatenate([z, fused[0][None]]), np.concatenate([r, fused[1][None]])

    def _gaussians(self, step: int, size: int, middle: NDArray[np.float64], quantity: Quantity) -> Array:
        """(K + 1, S, S) log densities of the modalities' Gaussians and of the fused Gaussian (``_moments``).

        The squared Mahalanobis distance is a sum of a term by column, a term by row and their product.
        """
        ix, iy = self.task.map_indices
        mean, covariance = self._moments(step, quantity)
        factor = np.linalg.cholesky(covariance)
        whiten = np.linalg.inv(factor)
        precision = whiten.swapaxes(-1, -2) @ whiten
        from_mean = wrapped(self.task, middle - mean)
        offsets = self._offsets(size).astype(np.float64)
        slope = (precision @ from_mean[..., None])[..., 0]
        along_x, along_y = (precision[:, i, i, None] * offsets**2 + 2.0 * slope[:, i, None] * offsets for i in (ix, iy))
        both = 2.0 * precision[:, ix, iy, None, None] * offsets[:, None] * offsets
        middle_squared = np.einsum("ln,ln->l", from_mean, slope)[:, None, None]
        squared = middle_squared + along_x[:, None, :] + along_y[:, :, None] + both
        log_det = np.log(np.einsum("lnn->ln", factor)).sum(-1)[:, None, None]
        constant = 0.5 * mean.shape[-1] * math.log(2.0 * math.pi)
        return (-0.5 * squared - log_det - constant).astype(np.float32)

"""Likelihood maps: likelihood or posterior over one or two state components, by modality, at one step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.covariance_floor import usual_variances, with_floor
from beliefscope.filters.engine import Progress, one_thread
from beliefscope.filters.external.likelihood import has_likelihood, log_likelihood
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.models.fusion import mixture, only_present
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.inspect.maps.availability import missing_quantities, no_maps
from beliefscope.inspect.maps.fusion_rules import fuse_sensors, fusion_rule
from beliefscope.inspect.maps.grid import GridEvaluator
from beliefscope.inspect.maps.likelihood_map import QUANTITIES, Array, LikelihoodMap, MapOptions, MapSteps, Quantity
from beliefscope.inspect.maps.map_statistics import has_layer_weights, layer_weights
from beliefscope.inspect.maps.particle_density import ParticleDensity
from beliefscope.inspect.maps.plane import OTHERS, Others, Plane, describe_others, other_components, plane_of
from beliefscope.inspect.statistics.measures import absent_modalities, wrap_angles
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.data import check_origin, check_step

Doubles = NDArray[np.float64]

__all__ = [
    "COARSE",
    "FINE",
    "LARGEST",
    "OTHERS",
    "QUANTITIES",
    "LikelihoodMap",
    "MapEngine",
    "Others",
    "Quantity",
]

COARSE, FINE = 41, 135
"""Cells per side: maps during scrubbing and of all steps; maps of a single step."""

LARGEST = 1024
"""Maximum number of cells per side."""


class MapEngine:
    """Computes the maps of one trace, reusing values that cells or steps share.

    Observations are encoded for all steps at once; ``GridEvaluator`` reuses values that depend on the grid.
    """

    def __init__(self, checkpoint: Checkpoint, trace: Trace, steps: MapSteps = None) -> None:
        """Raises BadInput if the filter has no maps (``no_maps``), or if the trace is from another checkpoint."""
        if why := no_maps(checkpoint, trace, steps=steps):
            raise BadInput(why)
        check_origin(checkpoint, trace)
        self.checkpoint = checkpoint
        self.trace = trace
        self.task = checkpoint.task
        self.evidence = self._encode()
        self._grid = self._grid_evaluator()
        self._calls_models = has_likelihood(checkpoint)
        self._planes: dict[tuple[str, ...], Plane] = {}
        self._anchors = trace.anchors
        self._present = ~absent_modalities(trace)  # (T, K)
        self._missing = missing_quantities(checkpoint, trace, steps)
        self.quantities = tuple(quantity for quantity in QUANTITIES if quantity not in self._missing)

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
        return GridEvaluator(models, filter_.statistics.mean_std("state")[1])

    def plane(self, components: tuple[str, ...] = ()) -> Plane:
        """The plane of one or two components, by default of the task's map. Raises BadInput (``plane_of``)."""
        if components not in self._planes:
            self._planes[components] = plane_of(self.trace, components)
        return self._planes[components]

    def no_map(self, step: int, quantity: Quantity | None = None) -> str | None:
        """Reason why a step has no map of a quantity, by default of the first one that the filter has, or None."""
        return no_maps(self.checkpoint, self.trace, quantity or self.quantities[0], [step])

    def no_others(self, quantity: Quantity, others: Others) -> str | None:
        """Reason why components off the map cannot be treated this way for a quantity; None if they can."""
        if others == "marginal" and quantity == "likelihood" and (self.evidence is not None or self._calls_models):
            return "the likelihood of a particle filter cannot be integrated over components: choose the posterior"
        return None

    @torch.no_grad()
    def map(
        self,
        step: int,
        angle: float | None = None,
        size: int = FINE,
        quantity: Quantity | None = None,
        components: tuple[str, ...] = (),
        others: Others | None = None,
    ) -> LikelihoodMap:
        """Compute the maps of one step.

        Args:
            angle: SI, value of the component off the map if it is the only one and fixed; by default the true value.
            size: cells per side, S.
            quantity: by default the likelihood, or the posterior for a filter that reports only that (``quantities``).
            components: names of the x and the y axis, or one for a curve; by default those of the task's map.
            others: treatment of the components off the map. Default: one is fixed; several are integrated out if
                possible (``no_others``), because a map at fixed values of all of them shows little of the belief.

        Raises:
            BadInput: step, angle, size or components are invalid, or the filter or step does not have such maps.
        """
        quantity = quantity or self.quantities[0]
        check_name("map quantity", quantity, QUANTITIES)
        if quantity not in self.quantities:
            raise BadInput(self._missing[quantity])
        trace = self.trace
        check_step(step, len(trace), "episode")
        if why := self.no_map(step, quantity):
            raise BadInput(why)
        if not 2 <= size <= LARGEST:
            raise BadInput(f"a map has 2 to {LARGEST} cells per side, not {size}")
        if angle is not None and not math.isfinite(angle):
            raise BadInput(f"angle must be a finite number of rad, not {angle}")
        plane = self.plane(components)
        off_map = other_components(trace, plane)
        if others is None:
            others = "marginal" if len(off_map) > 1 and self.no_others(quantity, "marginal") is None else "fixed"
        check_name("treatment of the components that are not on the map", others, OTHERS)
        if reason := self.no_others(quantity, others):
            raise BadInput(reason)
        anchor = self._anchors[step]
        middle, fixed = anchor.astype(np.float64), off_map[0] if len(off_map) == 1 and others == "fixed" else None
        if fixed is not None and angle is not None:
            middle[fixed] = angle
        with one_thread():
            values = self._densities(quantity, others)(step, size, middle, plane, quantity, others)
        x, y = (offsets.astype(np.float32) for offsets in plane.offsets(size))
        return LikelihoodMap(
            step=step,
            angle=math.nan if fixed is None else float(middle[fixed]),
            layers=(*self._modalities(quantity), "fused"),
            offsets_x=x,
            offsets_y=y,
            centre=anchor[list(plane.components)],
            log_likelihood=values,
            quantity=quantity,
            rule=fusion_rule(self.checkpoint, self._modalities(quantity), quantity),
            components=plane.components,
            others=others,
            note=describe_others(trace, plane, others),
        )

    def available_map(self, step: int, size: int, options: MapOptions) -> LikelihoodMap:
        """Compute one map. A quantity or treatment of other components that filter or step do not have is replaced."""
        wanted = [quantity for quantity in (options.quantity, *self.quantities) if quantity in self.quantities]
        quantity = next((quantity for quantity in wanted if self.no_map(step, quantity) is None), wanted[0])
        others = options.others
        if others is not None and self.no_others(quantity, others) is not None:
            others = None
        return self.map(step, options.angle, size, quantity, options.components, others)

    def maps(
        self,
        steps: Sequence[int],
        size: int = FINE,
        progress: Progress = None,
        quantity: Quantity | None = None,
    ) -> Iterator[LikelihoodMap]:
        """Default maps of the steps that have one. ``progress`` is called with the completed fraction, 0..1."""
        for count, step in enumerate(steps, start=1):
            if self.no_map(step, quantity) is None:
                yield self.map(step, size=size, quantity=quantity)
            if progress is not None:
                progress(count / len(steps))

    def _modalities(self, quantity: Quantity) -> tuple[str, ...]:
        """Modalities with a map: none for posteriors of a filter that reports only the fused one."""
        trace = self.trace
        has_maps = quantity == "likelihood" or has_layer_weights(trace) or bool(trace.modalities_with_posterior)
        return trace.modalities if has_maps else ()

    def _densities(self, quantity: Quantity, others: Others) -> Callable[..., Array]:
        """The method that evaluates a quantity: networks, kernel densities of particles, or Gaussians."""
        if self.evidence is not None and others == "fixed":
            return self._networks
        if quantity == "likelihood" and self._calls_models:
            return self._measurement_models
        if quantity == "posterior" and has_layer_weights(self.trace):
            return self._kernel_densities
        return self._gaussians

    def _networks(
        self, step: int, size: int, middle: Doubles, plane: Plane, quantity: Quantity, others: Others
    ) -> Array:
        """(K + 1, R, S) log-likelihoods of the measurement models and of the fused mixture, or log posteriors.

        The posterior is ``p(x) p(z | x) / p(z)``: the prior p(x) is the density of the predicted particles, and the
        evidence p(z) the mean likelihood of the particles under their prior weights.
        """
        filter_, trace = self.checkpoint.filter, self.trace
        assert isinstance(filter_, MixtureParticleFilter)
        assert self.evidence is not None
        evidence = self.evidence[step]
        assert self._grid is not None
        x, y = plane.offsets(size)
        unimodal = self._grid.log_likelihood(
            plane.along,
            torch.from_numpy(x.astype(np.float32)),
            torch.from_numpy(y.astype(np.float32)),
            filter_.statistics.standardise("state", torch.from_numpy(middle)),
            (*plane.components, *middle.tolist()),
            evidence.observation[0],
        )
        assert trace.prior_log_weights is not None
        assert trace.log_likelihood is not None
        prior, particle_likelihood = trace.prior_log_weights[step], trace.log_likelihood[step]
        scale = filter_.scale(torch.from_numpy(prior)[None], torch.from_numpy(particle_likelihood)[None])[0]
        # The trace's weights: they may be manual.
        log_weights = None if trace.weights is None else torch.from_numpy(trace.weights[step]).log()
        present = torch.from_numpy(self._present[step])

        def with_fused(each: Tensor) -> Tensor:
            return torch.cat([each, mixture(only_present((each - scale)[None], present[None]), log_weights)])

        values = with_fused(unimodal.masked_fill(~present[:, None], 0.0))
        if quantity == "posterior":
            assert trace.particles is not None
            at_particles = with_fused(torch.from_numpy(particle_likelihood))
            evidence_ = torch.logsumexp(torch.from_numpy(prior) + at_particles, dim=1, keepdim=True)
            density = ParticleDensity(self.task, self.task.near(trace.particles[step], middle), prior)
            log_prior = density.log_density(middle, plane.along, x, y).astype(np.float32)
            values = values - evidence_ + torch.from_numpy(log_prior).flatten()
        return values.unflatten(1, (len(y), size)).numpy()

    def _measurement_models(
        self, step: int, size: int, middle: Doubles, plane: Plane, quantity: Quantity, others: Others
    ) -> Array:
        """(K + 1, R, S) log-likelihoods of an external filter's own models, called for all cells at once."""
        assert isinstance(self.checkpoint, ExternalFilter)
        ix, iy = plane.along
        x, y = plane.offsets(size)
        offsets = np.zeros((len(y), size, len(middle)))
        offsets[..., ix] += x
        offsets[..., iy] += y[:, None]
        states = self.task.moved(middle, offsets)  # the axes of the map are body axes at its centre
        cells, count = states.reshape(-1, states.shape[-1]).astype(np.float32), len(self.trace.modalities)
        values = log_likelihood(self.checkpoint, self.trace.episode, step, cells, count)
        return values.reshape(-1, len(y), size)

    def _kernel_densities(
        self, step: int, size: int, middle: Doubles, plane: Plane, quantity: Quantity, others: Others
    ) -> Array:
        """(K + 1, R, S) log densities of the particles with the weights of each posterior."""
        particles, weights = self.trace.particles, layer_weights(self.trace, step)
        assert particles is not None
        x, y = plane.offsets(size)
        components = plane.components if others == "marginal" else None
        with np.errstate(divide="ignore"):
            states = self.task.near(particles[step], middle)  # tangent space at the centre of the map
            densities = [ParticleDensity(self.task, states, np.log(layer), components) for layer in weights]
        return np.stack([d.log_density(middle, plane.along, x, y) for d in densities]).astype(np.float32)

    def _moments(self, step: int, quantity: Quantity) -> tuple[Doubles, Doubles]:
        """Means (K + 1, n) and covariances (K + 1, n, n) of the sensors or posteriors, the fused one last."""
        trace = self.trace
        if quantity == "posterior":
            mean, covariance = trace.estimate_mean[step][None], trace.estimate_covariance[step][None]
            if trace.modalities_with_posterior:
                mean = np.concatenate([trace.modality_mean[step], mean])
                covariance = np.concatenate([trace.modality_covariance[step], covariance])
            if trace.particles is not None:  # the weights may be concentrated on one particle
                covariance = with_floor(covariance, usual_variances(trace.estimate_covariance))
            return mean.astype(np.float64), covariance.astype(np.float64)
        assert trace.observation_mean is not None
        assert trace.observation_covariance is not None
        sensors, noise = trace.observation_mean[step], trace.observation_covariance[step]
        z, r = sensors.astype(np.float64), noise.astype(np.float64)
        weights = None if trace.weights is None else trace.weights[step]
        fused = fuse_sensors(self.checkpoint, z, r, weights, self._present[step])
        return np.concatenate([z, fused[0][None]]), np.concatenate([r, fused[1][None]])

    def _gaussians(
        self, step: int, size: int, middle: Doubles, plane: Plane, quantity: Quantity, others: Others
    ) -> Array:
        """(K + 1, R, S) log densities of the modalities' Gaussians and of the fused Gaussian (``_moments``).

        The squared Mahalanobis distance is a sum of a term by column, a term by row and their product. The marginal of
        a Gaussian has the mean and the covariance of the remaining components. Angles differ by at most half a turn.
        """
        ix, iy = plane.along
        mean, covariance = self._moments(step, quantity)
        from_mean = self.task.difference(middle, mean)
        if others == "marginal":
            kept = list(plane.components)
            from_mean, covariance = from_mean[:, kept], covariance[:, kept][:, :, kept]
            ix, iy = 0, len(kept) - 1
        factor = np.linalg.cholesky(covariance)
        whiten = np.linalg.inv(factor)
        precision = whiten.swapaxes(-1, -2) @ whiten
        x, y = plane.offsets(size)
        slope = (precision @ from_mean[..., None])[..., 0]
        x, y = (
            self._within_half_a_turn(from_mean[:, i, None], d, k)
            for i, d, k in ((ix, x, plane.along[0]), (iy, y, plane.along[1]))
        )  # (L, S), (L, R)
        along_x, along_y = (
            precision[:, i, i, None] * d**2 + 2.0 * slope[:, i, None] * d for i, d in ((ix, x), (iy, y))
        )
        both = 2.0 * precision[:, ix, iy, None, None] * y[:, :, None] * x[:, None]
        middle_squared = np.einsum("ln,ln->l", from_mean, slope)[:, None, None]
        squared = middle_squared + along_x[:, None, :] + along_y[:, :, None] + both
        log_det = np.log(np.einsum("lnn->ln", factor)).sum(-1)[:, None, None]
        constant = 0.5 * from_mean.shape[-1] * math.log(2.0 * math.pi)
        values = (-0.5 * squared - log_det - constant).astype(np.float32)
        if quantity == "likelihood":
            present = self._present[step]
            values[~np.append(present, present.any())] = 0.0
        return values

    def _within_half_a_turn(self, from_mean: Doubles, offsets: Doubles, component: int) -> Doubles:
        """(L, S) offsets from the centre whose sums with the differences (L, 1) from a mean are at most half a turn."""
        if self.task.components[component].unit != "rad" or self.task.components[component].rotation:
            return np.broadcast_to(offsets, (len(from_mean), len(offsets)))
        return wrap_angles((from_mean + offsets)[..., None], [0])[..., 0] - from_mean

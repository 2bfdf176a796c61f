"""Likelihood maps: how likely each modality finds every position of the map square, at one step."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.fusion import mixture
from beliefscope.filters.pf import ParticleFilter
from beliefscope.inspect.trace import Trace

Array = NDArray[np.float32]

LARGEST = 1024
"""Cells along a side that a map may have."""


@dataclass(frozen=True)
class LikelihoodMap:
    """One map per modality and one fused, over offsets from the true position.

    PF: the measurement models' log-likelihood, and their mixture as it is fused. EKF, UKF: log density of each unimodal
    posterior and of the fused one.

    Attributes:
        step: of the trace. angle: value of the one component that is held fixed (rad), NaN where there is none.
        layers: names: the trace's modalities, then ``fused``; L of them.
        offsets_x, offsets_y: (S,) m, cell centres, increasing, relative to ``centre``. centre: (2,) m, the true
            position.
        log_likelihood: (L, S, S) natural log, not normalised; [l, iy, ix] belongs to offsets_y[iy], offsets_x[ix].
    """

    step: int
    angle: float
    layers: tuple[str, ...]
    offsets_x: Array
    offsets_y: Array
    centre: Array
    log_likelihood: Array

    def normalised(self) -> NDArray[np.uint8]:
        """(L, S, S) uint8: likelihood over its own layer's maximum, times 255, rounded."""
        peak = self.log_likelihood.max(axis=(1, 2), keepdims=True)
        return np.rint(255.0 * np.exp(self.log_likelihood - peak)).astype(np.uint8)

    def peaks(self) -> Array:
        """(L, 2) m: offset (x, y) of each layer's maximum."""
        flat = self.log_likelihood.reshape(len(self.layers), -1).argmax(axis=1)
        iy, ix = np.unravel_index(flat, self.log_likelihood.shape[1:])
        return np.stack([self.offsets_x[ix], self.offsets_y[iy]], axis=1)


def no_maps(checkpoint: Checkpoint) -> str | None:
    """Why a filter has no likelihood maps, in one line; None where it has them."""
    task, what = checkpoint.task, "has no likelihood maps"
    if not checkpoint.filter.has_covariance:
        kind = checkpoint.kind.upper()
        return f"filter {checkpoint.name!r} {what}: an {kind} estimates the state, but not how likely others are"
    off = [c.name for i, c in enumerate(task.components) if i not in task.map_indices]
    if len(off) > 1:
        return f"task {task.name!r} {what}: {', '.join(off)} are off the map; one at most can be held fixed"
    return None


class MapEngine:
    """Maps of one trace. What depends on the observations is computed once, for all steps."""

    def __init__(self, checkpoint: Checkpoint, trace: Trace) -> None:
        """Raises BadInput where there are none (``no_maps``), and when the trace was made by another checkpoint."""
        if why := no_maps(checkpoint):
            raise BadInput(why)
        if trace.checkpoint_hash != checkpoint.hash:
            raise BadInput(
                f"the trace was made by checkpoint {trace.checkpoint_hash[:12]}, not by {checkpoint.hash[:12]}"
            )
        self.checkpoint = checkpoint
        self.trace = trace
        self.task = checkpoint.task
        self.evidence = self._encode()
        rest = [i for i in range(len(self.task.components)) if i not in self.task.map_indices]
        self.fixed = rest[0] if rest else None
        self._grid = lru_cache(maxsize=4)(self._compute_grid)

    @torch.no_grad()
    def _encode(self) -> Evidence | None:
        filter_ = self.checkpoint.filter
        if not isinstance(filter_, ParticleFilter):
            return None
        return filter_.encode(Steps.of(self.task, [self.trace.episode]).episode(0))

    def _compute_grid(self, size: int, x: float, y: float) -> tuple[Array, Tensor]:
        """Offsets (S,) and states (S * S, n) in SI units, row by row, the fixed component zero."""
        half = self.task.map_half_width
        offsets = ((np.arange(size) + 0.5) / size * 2.0 - 1.0) * half
        states = np.zeros((size, size, len(self.task.components)), np.float32)
        ix, iy = self.task.map_indices
        states[..., ix] = x + offsets
        states[..., iy] = y + offsets[:, None]
        return offsets.astype(np.float32), torch.from_numpy(states.reshape(size * size, -1))

    @torch.no_grad()
    def map(self, step: int, angle: float | None = None, size: int = 135) -> LikelihoodMap:
        """The maps at one step.

        Args:
            angle: rad, value of the component off the map; the true one by default. size: cells along a side, S.

        Raises:
            BadInput: step, angle or size out of range.
        """
        trace = self.trace
        if not 0 <= step < len(trace):
            raise BadInput(f"step {step} is not in this episode: it has steps 0 to {len(trace) - 1}")
        if not 2 <= size <= LARGEST:
            raise BadInput(f"a map has 2 to {LARGEST} cells along a side, not {size}")
        if angle is not None and not math.isfinite(angle):
            raise BadInput(f"angle must be a finite number of rad, not {angle}")
        truth = trace.episode.states[step]
        centre = truth[list(self.task.map_indices)]
        offsets, states = self._grid(size, float(centre[0]), float(centre[1]))
        if self.fixed is None:
            angle = math.nan
        else:
            angle = float(truth[self.fixed]) if angle is None else angle
            states = states.clone()
            states[:, self.fixed] = angle
        values = self._particle_filter(step, states) if self.evidence is not None else self._gaussians(step, states)
        return LikelihoodMap(
            step=step,
            angle=angle,
            layers=(*trace.modalities, "fused"),
            offsets_x=offsets,
            offsets_y=offsets,
            centre=centre,
            log_likelihood=values.reshape(-1, size, size).numpy(),
        )

    def maps(self, steps: Iterable[int], size: int = 135) -> Iterator[LikelihoodMap]:
        """The maps at several steps, at the true angle."""
        return (self.map(step, size=size) for step in steps)

    def _particle_filter(self, step: int, states: Tensor) -> Tensor:
        """(K + 1, S * S) log-likelihoods of the measurement models and of their mixture."""
        filter_ = self.checkpoint.filter
        assert isinstance(filter_, ParticleFilter)
        assert self.evidence is not None
        evidence = self.evidence[step]
        standard = filter_.statistics.standardise("state", states).unsqueeze(0)
        each = filter_.log_likelihood(evidence, standard)[0]
        trace = self.trace
        assert trace.prior_log_weights is not None
        assert trace.log_likelihood is not None
        prior, of_particles = trace.prior_log_weights[step], trace.log_likelihood[step]
        scale = filter_.scale(torch.from_numpy(prior)[None], torch.from_numpy(of_particles)[None])[0]
        log_weights = None if evidence.log_weights is None else evidence.log_weights[0]
        return torch.cat([each, mixture(each - scale, log_weights).unsqueeze(0)])

    def _gaussians(self, step: int, states: Tensor) -> Tensor:
        """(K + 1, S * S) log densities of each unimodal posterior and of the fused one."""
        trace = self.trace
        mean = np.concatenate([trace.modality_mean[step], trace.estimate_mean[step][None]])
        covariance = np.concatenate([trace.modality_covariance[step], trace.estimate_covariance[step][None]])
        factor = torch.linalg.cholesky(torch.from_numpy(covariance).double())
        difference = states.double() - torch.from_numpy(mean).double()[:, None]
        white = torch.linalg.solve_triangular(factor, difference.transpose(-1, -2), upper=False)
        log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True)
        constant = 0.5 * states.shape[-1] * math.log(2.0 * math.pi)
        return (-0.5 * white.square().sum(-2) - log_det - constant).float()

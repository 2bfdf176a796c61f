"""Likelihood maps: how likely each modality finds every position of the map square, at one step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import Foreign
from beliefscope.filters.models.fusion import mixture
from beliefscope.filters.models.pf import ParticleFilter
from beliefscope.inspect.maps.grid import Cells, one_thread
from beliefscope.inspect.statistics.measures import wrapped
from beliefscope.inspect.trace import Trace

Array = NDArray[np.float32]

COARSE, FINE = 41, 135
"""Cells along a side of a map that is drawn while a hand moves, or made of every step; and of one to look at."""

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
            position, or where it is not known the fused estimate.
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


def no_maps(checkpoint: Checkpoint, trace: Trace | None = None) -> str | None:
    """Why a filter has no likelihood maps, in one line; None where it has them.

    Args:
        trace: of the filter. One from outside has those that follow from its trace: its Gaussians.
    """
    task, what = checkpoint.task, "has no likelihood maps"
    if isinstance(checkpoint, Foreign):
        if why := _nothing_to_map(trace):
            return f"filter {checkpoint.name!r} {what}: {why}"
    elif not checkpoint.filter.has_covariance:
        kind = checkpoint.kind.upper()
        return f"filter {checkpoint.name!r} {what}: an {kind} estimates the state, but not how likely others are"
    off = [c.name for i, c in enumerate(task.components) if i not in task.map_indices]
    if len(off) > 1:
        return f"task {task.name!r} {what}: {', '.join(off)} are off the map; one at most can be held fixed"
    return None


def _nothing_to_map(trace: Trace | None) -> str | None:
    """Why there are no Gaussians to draw of a filter from outside."""
    if trace is None or not trace.has_covariance:
        return "it estimates the state, but does not say how likely others are"
    if trace.log_likelihood is not None or trace.particles is not None:
        return (
            "its particles are known, but its measurement model cannot be asked about states that none of them visited"
        )
    if trace.modalities and not trace.alone:
        return "it does not say what each modality alone believes"
    both = np.concatenate([trace.modality_covariance, trace.estimate_covariance[:, None]], axis=1)
    flat = np.linalg.eigvalsh(both.astype(np.float64)).min(axis=(1, 2)) <= 0.0
    return f"a covariance of step {int(flat.argmax())} is not positive definite" if flat.any() else None


class MapEngine:
    """Maps of one trace, with each thing computed once that several cells or steps share.

    What depends on the observations: for all steps together. What depends on the cells: in ``Cells``.
    """

    def __init__(self, checkpoint: Checkpoint, trace: Trace) -> None:
        """Raises BadInput where there are none (``no_maps``), and when the trace was made by another checkpoint."""
        if why := no_maps(checkpoint, trace):
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
        self._cells = self._networks()
        self._anchors = trace.anchors

    @torch.no_grad()
    def _encode(self) -> Evidence | None:
        if self.trace.log_likelihood is None:
            return None
        filter_ = self.checkpoint.filter
        return filter_.encode(Steps.of(self.task, [self.trace.episode]).episode(0))

    def _networks(self) -> Cells | None:
        if self.evidence is None:
            return None
        filter_ = self.checkpoint.filter
        assert isinstance(filter_, ParticleFilter)
        models = [filter_.measurement_model(name) for name in filter_.names]
        return Cells(models, self.task.map_indices, filter_.statistics.mean_std("state")[1])

    @torch.no_grad()
    def map(self, step: int, angle: float | None = None, size: int = FINE) -> LikelihoodMap:
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
        about = self._anchors[step]
        middle, centre = about.astype(np.float64), about[list(self.task.map_indices)]
        if self.fixed is not None and angle is not None:
            middle[self.fixed] = angle
        with one_thread():
            values = (self._particle_filter if self.evidence is not None else self._gaussians)(step, size, middle)
        return LikelihoodMap(
            step=step,
            angle=math.nan if self.fixed is None else float(middle[self.fixed]),
            layers=(*trace.modalities, "fused"),
            offsets_x=self._offsets(size),
            offsets_y=self._offsets(size),
            centre=centre,
            log_likelihood=values,
        )

    def maps(
        self, steps: Sequence[int], size: int = FINE, progress: Callable[[float], None] | None = None
    ) -> Iterator[LikelihoodMap]:
        """The maps at several steps, at the true angle. ``progress`` is called with the share done, 0..1."""
        for count, step in enumerate(steps, start=1):
            yield self.map(step, size=size)
            if progress is not None:
                progress(count / len(steps))

    def _offsets(self, size: int) -> Array:
        """(S,) m, cell centres."""
        offsets = ((np.arange(size) + 0.5) / size * 2.0 - 1.0) * self.task.map_half_width
        return offsets.astype(np.float32)

    def _particle_filter(self, step: int, size: int, middle: NDArray[np.float64]) -> Array:
        """(K + 1, S, S) log-likelihoods of the measurement models and of their mixture."""
        filter_, trace = self.checkpoint.filter, self.trace
        assert isinstance(filter_, ParticleFilter)
        assert self.evidence is not None
        evidence = self.evidence[step]
        assert self._cells is not None
        each = self._cells.log_likelihood(
            torch.from_numpy(self._offsets(size)),
            filter_.statistics.standardise("state", torch.from_numpy(middle)),
            tuple(middle.tolist()),
            evidence.observation[0],
        )
        assert trace.prior_log_weights is not None
        assert trace.log_likelihood is not None
        prior, of_particles = trace.prior_log_weights[step], trace.log_likelihood[step]
        scale = filter_.scale(torch.from_numpy(prior)[None], torch.from_numpy(of_particles)[None])[0]
        # The trace's: they may have been set by hand.
        log_weights = None if trace.weights is None else torch.from_numpy(trace.weights[step]).log()
        values = torch.cat([each, mixture(each - scale, log_weights).unsqueeze(0)])
        return values.unflatten(1, (size, size)).numpy()

    def _gaussians(self, step: int, size: int, middle: NDArray[np.float64]) -> Array:
        """(K + 1, S, S) log densities of each unimodal posterior and of the fused one.

        The squared Mahalanobis distance is a sum over columns, over rows, and over their product.
        """
        trace, (ix, iy) = self.trace, self.task.map_indices
        mean = np.concatenate([trace.modality_mean[step], trace.estimate_mean[step][None]]).astype(np.float64)
        covariance = np.concatenate([trace.modality_covariance[step], trace.estimate_covariance[step][None]])
        factor = np.linalg.cholesky(covariance.astype(np.float64))
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

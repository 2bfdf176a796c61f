"""Fused layer of a map: its rule in words, and the fused likelihood of virtual sensors."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.likelihood import has_likelihood
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.fusion import product_of_experts
from beliefscope.inspect.maps.likelihood_map import Quantity
from beliefscope.inspect.statistics.signals import Array


def fusion_rule(checkpoint: Checkpoint, modalities: tuple[str, ...], quantity: Quantity) -> str:
    """Name of the rule that results in the fused layer."""
    if not modalities:
        return f"{quantity} reported by the filter"
    if len(modalities) == 1:
        return f"{quantity} of the only measurement model"
    if isinstance(checkpoint, ExternalFilter):
        if quantity == "likelihood" and has_likelihood(checkpoint):
            return "the filter's own measurement model"
        likelihood = "product of likelihoods (the filter's own rule is unknown)"
        return likelihood if quantity == "likelihood" else "posterior reported by the filter"
    architecture = checkpoint.filter.architecture
    crossmodal = architecture.fusion == "crossmodal"
    if architecture.fusion == "information":
        rule = "beta-weighted product of virtual sensors (one prior)"
        return rule if quantity == "likelihood" else f"prior times {rule}"
    if architecture.kind == "pf":
        kind = "likelihoods" if architecture.likelihoods == "raw" else "normalised likelihoods"
        rule = f"beta-weighted sum of {kind} (crossmodal)" if crossmodal else f"sum of {kind} (unimodal)"
        return rule if quantity == "likelihood" else f"prior times {rule}"
    subject = "virtual sensors" if quantity == "likelihood" else "posteriors"
    return f"beta-weighted mean of {subject} (crossmodal)" if crossmodal else f"product of {subject} (unimodal)"


def fuse_sensors(
    checkpoint: Checkpoint,
    mean: Array,
    covariance: Array,
    weights: NDArray[np.float32] | None,
    present: NDArray[np.bool_],
) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of the filter's rule applied to virtual sensors instead of posteriors.

    It is the fused posterior in the limit of a flat prior, where each modality's posterior is its sensor's Gaussian.
    An external filter, whose rule is unknown, has the product.

    Args:
        mean, covariance: (K, n), (K, n, n), z and R. weights: (K, W) beta of the trace, or None.
        present: (K,) sensors with a reading.
    """
    with_reading = torch.from_numpy(present)[None]
    bank = Gaussian(torch.from_numpy(mean)[None], torch.from_numpy(covariance)[None])
    if isinstance(checkpoint, ExternalFilter):
        fused = product_of_experts(bank, with_reading)
    else:
        assert isinstance(checkpoint.filter, ExtendedKalmanFilter)
        beta = None if weights is None else torch.from_numpy(weights.astype(np.float64)).log()[None]
        fused = checkpoint.filter.fuse(bank, beta, with_reading)
    return fused.mean[0].numpy(), fused.covariance[0].numpy()

"""Share of each modality in the weights of particles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.maps.map_statistics import has_layer_weights, layer_weights
from beliefscope.inspect.trace import Trace


def modality_shares(trace: Trace, step: int) -> NDArray[np.float32] | None:
    """(K, M) share of each modality in each particle's weight: ``e_k w_k / sum_j e_j w_j``.

    e_k are the effective weights and w_k the particle weights of a unimodal update, which sum to one. So the mean of
    the shares under the fused weights is the effective weight. None if the filter has no separate modalities.
    """
    if trace.effective_weights is None or not has_layer_weights(trace):
        return None
    weights = layer_weights(trace, step)[:-1]
    joint = trace.effective_weights[step] * weights  # effective weights of particle filters are (K, 1)
    total = joint.sum(axis=0)
    shares = joint / np.maximum(total, np.finfo(np.float32).tiny)
    return np.where(total > 0.0, shares, trace.effective_weights[step])

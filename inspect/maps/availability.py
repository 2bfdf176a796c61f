"""Which likelihood maps a filter and its trace have, and the reasons why others are missing."""

from __future__ import annotations

import numpy as np

from beliefscope.filters.catalog import KINDS
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.likelihood import has_likelihood
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.maps.likelihood_map import QUANTITIES, MapSteps, Quantity
from beliefscope.inspect.maps.map_statistics import has_layer_weights
from beliefscope.inspect.trace import Trace


def no_maps(
    checkpoint: Checkpoint,
    trace: Trace | None = None,
    quantity: Quantity | None = None,
    steps: MapSteps = None,
) -> str | None:
    """One-line reason why a filter has no maps of a quantity, or None.

    Args:
        trace: a trace of the filter; required for an external filter, whose maps are computed from its Gaussians and
            particles.
        quantity: by default either.
        steps: of the maps, which all need valid covariances; by default, one that has them suffices.
    """
    subject = "has no likelihood maps" if quantity != "posterior" else "has no posterior maps"
    if trace is not None and (only := trace.settings.get("standalone")):
        return f"{only} standalone {subject}; the maps of the run with all modalities show {only}"
    if isinstance(checkpoint, ExternalFilter):
        wanted = (quantity,) if quantity else QUANTITIES
        reasons = [_no_density(checkpoint, trace, each, steps) for each in wanted]
        if None not in reasons:
            return f"filter {checkpoint.name!r} {subject}: {reasons[-1]}"
    elif not KINDS[checkpoint.kind].has_covariance:
        kind = {"lstm": "an LSTM"}.get(checkpoint.kind, f"a {checkpoint.kind}")
        return f"filter {checkpoint.name!r} {subject}: {kind} has no likelihood and no covariance"
    return None


def missing_quantities(checkpoint: Checkpoint, trace: Trace, steps: MapSteps = None) -> dict[Quantity, str]:
    """Quantities without maps of this filter, with the reasons (``no_maps``)."""
    reasons = {quantity: no_maps(checkpoint, trace, quantity, steps) for quantity in QUANTITIES}
    return {quantity: reason for quantity, reason in reasons.items() if reason is not None}


def _no_density(checkpoint: ExternalFilter, trace: Trace | None, quantity: Quantity, steps: MapSteps) -> str | None:
    """Reason why an external filter has no density of a quantity, from Gaussians or particles; None if it has."""
    if trace is None or not trace.has_covariance:
        return "it reports no covariance"
    if quantity == "likelihood" and has_likelihood(checkpoint):
        return None
    wanted = np.arange(len(trace)) if steps is None else np.array(steps)
    if quantity == "likelihood":
        if trace.observation_mean is None or trace.observation_covariance is None:
            if trace.particles is not None:
                return "its measurement model is known only at its particles"
            return "it reports no virtual observations (observation_mean and observation_covariance)"
        covariances = trace.observation_covariance[wanted]
    elif has_layer_weights(trace):
        return None
    else:
        covariances = trace.estimate_covariance[wanted][:, None]
        if trace.modalities_with_posterior:
            covariances = np.concatenate([trace.modality_covariance[wanted], covariances], axis=1)
    degenerate = np.linalg.eigvalsh(covariances.astype(np.float64)).min(axis=(1, 2)) <= 0.0
    if not (degenerate.all() if steps is None else degenerate.any()):
        return None
    return f"a covariance of step {wanted[degenerate.argmax()]} is not positive definite"

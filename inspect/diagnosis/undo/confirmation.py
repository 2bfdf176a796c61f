"""Confirmation of causes: undo each and replay the episodes with the same random numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.diagnosis.cause import Cause, Recovery
from beliefscope.inspect.diagnosis.undo.run_inputs import Deviations, RunInputs
from beliefscope.inspect.diagnosis.undo.undo import undo
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.innovations import virtual_innovations
from beliefscope.inspect.statistics.intervals import jackknife
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all


def replay_without(
    cause: Cause, inputs: RunInputs, deviations: Deviations, seed: int, base: Checkpoint | None = None
) -> tuple[str, list[Trace]] | None:
    """The first intervention that can undo a cause, and traces of the episodes without it, in their order; or None.

    None also for a filter that cannot run again.
    """
    if isinstance(inputs.checkpoint, UnavailableFilter):
        return None
    for name in filter(None, cause.undo.split("|")):
        try:
            changed = undo(name, inputs, deviations, base)
        except BadInput:  # modules of an external filter cannot be changed
            return None
        if changed is not None:
            return name, list(
                trace_all(changed.checkpoint, changed.episodes, changed.episodes, seed, changed.particles)
            )
    return None


def recovery(before: Sequence[Trace], after: Sequence[Trace]) -> Recovery:
    """Effect of an undone cause: share of an RMS error that it removes, and the decrease of the NLL.

    Of the main error and those of the other components, that which falls most: a fault may concern one only.
    """
    nll = float(np.mean([negative_log_likelihood(trace) for trace in before]))
    nll -= float(np.mean([negative_log_likelihood(trace) for trace in after]))
    names = measures.error_names(before[0].task)
    sums = np.array([[measures.squared_errors(trace) for trace in pair] for pair in zip(before, after, strict=True)])
    if not np.isfinite(sums).all():
        return Recovery(np.nan, np.nan, np.nan, nll, names[0])
    k = int(np.argmax(measures.removed_share(sums.sum(0).T)))
    share, low, high = jackknife(sums[..., k], measures.removed_share)
    return Recovery(float(share), float(low), float(high), nll, names[k])


def negative_log_likelihood(trace: Trace) -> float:
    """Mean over the counted steps, nats; NaN if unknown.

    Of the true state under the posterior; without ground truth, of the virtual observations under their prediction.
    """
    keep = measures.counted(trace)
    if np.isfinite(trace.episode.states).all():
        pair = (measures.errors(trace)[:, -1], measures.covariances(trace)[:, -1]) if trace.has_covariance else None
    else:
        pair = virtual_innovations(trace)
    return float("nan") if pair is None else measures.known_mean(_gaussian_nll(pair[0][keep], pair[1][keep]))


def _gaussian_nll(error: Array, covariance: Array) -> Array:
    """``(e^T S^-1 e + ln det S + n ln 2 pi) / 2`` of errors (..., n)."""
    squared = (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1)
    n = error.shape[-1]
    with np.errstate(invalid="ignore"):  # unknown covariances are NaN
        volume = np.linalg.slogdet(covariance).logabsdet
    return np.asarray(0.5 * (squared + volume + n * np.log(2.0 * np.pi)))

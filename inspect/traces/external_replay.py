"""Repeated runs of external filters: with interventions in sensors, and with some of their modalities only."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.filters.external.ablation import with_only
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.traces.data import Trace, check_origin, provenance_of, standalone_provenance
from beliefscope.inspect.traces.external import run_external
from beliefscope.inspect.traces.replay import Intervention, Replay, have_equal_arrays


def open_replay(checkpoint: Checkpoint, trace: Trace, progress: Progress = None) -> Replay | ExternalReplay:
    """The replay of a trace of any filter. Raises BadInput if the trace is from another checkpoint."""
    kind = ExternalReplay if isinstance(checkpoint, ExternalFilter) else Replay
    return kind(checkpoint, trace, progress)  # type: ignore[arg-type]


class ExternalReplay:
    """A repeated run of a trace of an external filter, from the state that the filter had before it.

    Attributes:
        original: trace of the repeated run.
        exact: whether ``original`` is bit-identical to the given trace. Otherwise the filter depends on something else
            than its inputs, its state and the global random generators.
    """

    def __init__(self, external: ExternalFilter, trace: Trace, progress: Progress = None) -> None:
        """Raises BadInput if the trace is from another filter. progress: called with the completed fraction."""
        check_origin(external, trace)
        self._external = external
        self._state: Any = None
        with suppress(BadInput):  # a filter without snapshots must return to its state in initialize_beliefs
            self._state = external.snapshot()
        self.original = _run(external, trace.episode, provenance_of(trace), progress)
        self.exact = have_equal_arrays(trace, self.original)

    def with_intervention(self, intervention: Intervention) -> Trace:
        """Trace of the run with an intervention, with the original's initial state and random numbers, as ``Replay``.

        All steps are run again, since only the filter knows which of them an input changes: a smoother also revises
        earlier ones.

        Raises BadInput for weights, unknown sensors, and steps outside the trace.
        """
        original = self.original
        intervention.check(self._external, len(original))
        episode = intervention.timed_faults.apply(original.episode, original.seed)
        if self._state is not None:
            self._external.restore(self._state)
        return _run(self._external, episode, intervention.provenance_after(original))


def run_alone(external: ExternalFilter, trace: Trace, modality: str, progress: Progress = None) -> Trace:
    """Trace of the filter over the trace's episode with one modality only. Raises BadInput as ``standalone``."""
    check_origin(external, trace)
    return _run(external, trace.episode, standalone_provenance(trace, modality), progress)


def run_with(
    external: ExternalFilter, trace: Trace, modalities: tuple[str, ...], start: Gaussian
) -> NDArray[np.float64]:
    """(T, n) estimates in SI units over the trace's episode with some modalities only, from a belief (1, n)."""
    episode = with_only(trace.episode, modalities, external.adapter.absent)
    values, _ = external.run([episode], trace.seed, start=start)
    return np.asarray(values["estimate_mean"][:, 0].double().numpy())


@torch.no_grad()
def _run(
    external: ExternalFilter,
    episode: Episode,
    provenance: dict[str, Any],
    progress: Progress = None,
) -> Trace:
    """Trace over an episode with its faults; of one modality if the settings name it as ``standalone``."""
    only = provenance["settings"].get("standalone", "")
    if not only:
        return run_external(external, episode, progress, **provenance)
    seen = with_only(episode, (only,), external.adapter.absent)
    return run_external(external, episode, progress, seen=seen, **provenance)

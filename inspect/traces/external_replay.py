"""Repeated runs of external filters: with interventions in sensors, and with some of their modalities only."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.ablation import with_only
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.traces.data import ARRAYS, Trace
from beliefscope.inspect.traces.external import run_external
from beliefscope.inspect.traces.replay import Intervention, Replay, equal

Progress = Callable[[float], None] | None

PROVENANCE = ("data_hash", "episode_index", "seed", "faults", "settings")


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
        provenance = {name: getattr(trace, name) for name in PROVENANCE}
        self.original = _run(external, trace.episode, provenance, progress)
        self.exact = all(equal(getattr(trace, name), getattr(self.original, name)) for name in ARRAYS)

    def check_step(self, step: int) -> None:
        """Raise BadInput for a step outside the trace."""
        if not 0 <= step < len(self.original):
            raise BadInput(f"step {step} is not in this trace: it has steps 0 to {len(self.original) - 1}")

    def with_intervention(self, intervention: Intervention) -> Trace:
        """Trace of the run with an intervention, with the original's initial state and random numbers, as ``Replay``.

        All steps are run again, since only the filter knows which of them an input changes: a smoother also revises
        earlier ones.

        Raises BadInput for weights, unknown sensors, and steps outside the trace.
        """
        original = self.original
        intervention.check(self._external, len(original))
        episode = intervention.timed_faults.apply(original.episode, original.seed)
        interventions = [*original.settings.get("edits", []), intervention.to_json()]
        provenance = {name: getattr(original, name) for name in PROVENANCE} | {
            "faults": original.faults + intervention.timed_faults,
            "settings": {**original.settings, "edits": interventions},
        }
        if self._state is not None:
            self._external.restore(self._state)
        return _run(self._external, episode, provenance)


def run_alone(external: ExternalFilter, trace: Trace, modality: str, progress: Progress = None) -> Trace:
    """Trace of the filter over the trace's episode with one modality only. Raises BadInput as ``standalone``."""
    check_origin(external, trace)
    settings = {key: value for key, value in trace.settings.items() if key != "edits"} | {"standalone": modality}
    return _run(
        external, trace.episode, {name: getattr(trace, name) for name in PROVENANCE} | {"settings": settings}, progress
    )


def run_with(
    external: ExternalFilter, trace: Trace, modalities: tuple[str, ...], start: Gaussian
) -> NDArray[np.float64]:
    """(T, n) estimates in SI units over the trace's episode with some modalities only, from a belief (1, n)."""
    episode = with_only(trace.episode, modalities, external.adapter.absent)
    values, _ = external.run([episode], trace.seed, start=start)
    return np.asarray(values["estimate_mean"][:, 0].double().numpy())


def check_origin(external: ExternalFilter, trace: Trace) -> None:
    """Raises BadInput for a trace of another filter."""
    if trace.checkpoint_hash != external.hash:
        raise BadInput(f"the trace is from checkpoint {trace.checkpoint_hash[:12]}, not from {external.hash[:12]}")


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

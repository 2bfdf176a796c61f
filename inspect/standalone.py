"""Standalone runs: a trace's filter with the observations of one modality only.

A trace's modality columns are updates: at every step, the prior of the fused filter, which has used all modalities in
earlier steps, is updated with one modality (``Trace.modality_mean``). The standalone filter of a modality has the same
networks, start and random numbers, but no step of its recursion uses any other modality.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.batch import Steps
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.filters.rollout import first_belief
from beliefscope.filters.subsets import modalities_of, standalone_evidence
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import part_of
from beliefscope.inspect.traces.data import check_origin, standalone_provenance
from beliefscope.inspect.traces.external_replay import run_alone
from beliefscope.inspect.traces.run import assemble_trace, join_parts, run_parts


def check_standalone(checkpoint: Checkpoint, modality: str) -> None:
    """Raise BadInput for a modality that the filter does not use."""
    if modality not in (modalities := modalities_of(checkpoint)):
        raise BadInput(f"Modality {modality!r} is not in this filter. Available: {', '.join(modalities)}.")


def removal_note(checkpoint: Checkpoint) -> str:
    """Warning about runs without some sensors, if an external filter takes their replacements for measurements."""
    if not isinstance(checkpoint, ExternalFilter) or checkpoint.adapter.absent == "nan":
        return ""
    return (
        "A removed sensor reads its mean over the episode, which the filter takes for a measurement; one that skips "
        'missing readings takes Adapter(absent="nan").'
    )


def standalone_runs(traces: Sequence[Trace], checkpoint: Checkpoint | None) -> dict[str, list[Trace]]:
    """Modality -> standalone run of each trace; empty for one modality, and without a filter that can run."""
    if checkpoint is None or isinstance(checkpoint, UnavailableFilter):
        return {}
    modalities = modalities_of(checkpoint)
    other = any("standalone" in trace.settings or trace.checkpoint_hash != checkpoint.hash for trace in traces)
    if other or len(modalities) < 2:
        return {}
    return {modality: [standalone(checkpoint, trace, modality) for trace in traces] for modality in modalities}


def standalone_errors(
    traces: Sequence[Trace], checkpoint: Checkpoint, progress: Progress = None
) -> list[measures.Array]:
    """Errors (T, K, n) of the standalone filter of each of the K input modalities, by trace; m and rad."""
    modalities = modalities_of(checkpoint)
    errors, runs = [], len(traces) * len(modalities)
    for i, trace in enumerate(traces):
        alone = [
            standalone(checkpoint, trace, modality, part_of(progress, i * len(modalities) + k, runs))
            for k, modality in enumerate(modalities)
        ]
        errors.append(np.stack([measures.errors(run)[:, -1] for run in alone], axis=1))
    return errors


@torch.no_grad()
def standalone(checkpoint: Checkpoint, trace: Trace, modality: str, progress: Progress = None) -> Trace:
    """Run the filter of a trace over the same episode with one modality only.

    Start, particles, seed and so the random numbers are those of the trace; its episode has the injected faults and
    those of its interventions. At every step the evidence of all other modalities is masked (``filters/subsets.py``);
    fusion weights, given or manual, play no part. The result is the trace of a filter with one modality: its estimate
    is the standalone estimate, and ``settings`` name the modality as ``standalone``. For a filter of one modality, all
    arrays but its effective weights equal those of the trace bit for bit. An external filter sees the other sensors
    without information (``filters/external/ablation.py``).

    Args:
        modality: an input of the filter (``modalities_of``).
        progress: called with the completed fraction, 0..1.

    Raises:
        BadInput: the filter does not use the modality, or the trace is of another filter.
    """
    check_standalone(checkpoint, modality)
    if isinstance(checkpoint, ExternalFilter):
        return run_alone(checkpoint, trace, modality, progress)
    check_origin(checkpoint, trace)
    filter_ = checkpoint.filter
    batch = Steps.from_episodes(filter_.task, [trace.episode]).episode(0)
    evidence = standalone_evidence(filter_, batch, filter_.encode(batch), modality)
    start, generator = first_belief(filter_, batch), torch.Generator().manual_seed(trace.seed)
    particles = int(trace.settings["particles"])
    kept = particles if trace.particles is None else trace.particles.shape[1]
    parts = run_parts(checkpoint, [evidence], len(trace), start, generator, particles, kept, progress)
    arrays = join_parts(parts, len(trace))
    return assemble_trace(checkpoint, trace.episode, start, arrays, **standalone_provenance(trace, modality))

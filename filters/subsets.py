"""Evidence of subsets of a filter's modalities, as if the other sensors did not exist.

With a single modality, this is the standalone filter of that modality: the same networks and the same recursion, in
which no other observation is ever used. It differs from the modality's update (``StepTrace.updates``), which starts at
every step from the prior of the fused filter.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Filter


def input_modalities(filter_: Filter) -> tuple[str, ...]:
    """The K input modalities of a filter, including modalities with a shared model."""
    return tuple(dict.fromkeys(modality for model in filter_.names for modality in model.split("+")))


def modalities_of(checkpoint: Checkpoint) -> tuple[str, ...]:
    """As ``input_modalities``; all of the task for an external filter, which may not read some of them."""
    if isinstance(checkpoint, ExternalFilter):
        return tuple(checkpoint.task.modalities)
    return input_modalities(checkpoint.filter)


def check_modality(filter_: Filter, modality: str) -> None:
    """Raises BadInput for a modality that the filter does not use."""
    if modality not in (modalities := input_modalities(filter_)):
        raise BadInput(f"Modality {modality!r} is not in this filter. Available: {', '.join(modalities)}.")


def standalone_evidence(filter_: Filter, batch: Batch, evidence: Evidence, modality: str) -> Evidence:
    """The batch's evidence with one modality only, at every step; arguments as for ``subset_evidence``.

    The modality's model has weight 1, whatever its beta.

    Raises BadInput for a modality that the filter does not use.
    """
    check_modality(filter_, modality)
    if evidence.log_weights is not None and sum(modality in model.split("+") for model in filter_.names) == 1:
        # Beta depends on all observations; normalised over the only model it would be 1, up to rounding.
        evidence = replace(evidence, log_weights=torch.zeros_like(evidence.log_weights))
    has = torch.tensor([name == modality for name in input_modalities(filter_)], device=batch.states.device)
    return subset_evidence(filter_, batch, evidence, has.expand(batch.states.shape[1], -1))


def subset_evidence(filter_: Filter, batch: Batch, evidence: Evidence, has: Tensor) -> Evidence:
    """Evidence (T, S, ...) in which trajectory s has only the modalities of row s of ``has``.

    Models without any of their modalities are deselected (``Evidence.select_models``); beta keeps the proportions of
    ``evidence``. In a shared model that lacks some of its modalities, and in a sequence model, missing images are black
    and missing vectors are at the training mean.

    Args:
        batch: N = S trajectories, or one for all S. evidence: of the batch.
        has: (S, K) bool, in the order of ``input_modalities``.
    """
    models = [model.split("+") for model in filter_.names]
    uses = torch.tensor([[modality in model for modality in input_modalities(filter_)] for model in models])
    present = (has[:, None] & uses.to(has.device)).any(-1)
    if any(len(model) > 1 for model in models) and not has.all():
        weights = evidence.log_weights
        evidence = replace(
            filter_.encode(_without(batch, filter_, has)),
            log_weights=None if weights is None else weights.expand(-1, len(has), -1, -1),
        )
    return evidence.select_models(present.expand(len(evidence), -1, -1))


def _without(batch: Batch, filter_: Filter, has: Tensor) -> Batch:
    """The batch of S trajectories whose modalities missing in ``has`` (S, K) are neutralised."""

    def expand(values: Tensor) -> Tensor:
        return values.expand(-1, len(has), *values.shape[2:])

    observations = {modality: expand(values) for modality, values in batch.observations.items()}
    for k, modality in enumerate(input_modalities(filter_)):
        values = observations[modality]
        available = has[:, k].reshape(-1, *(1,) * (values.ndim - 2))
        neutral = values.new_zeros(()) if values.ndim == 4 else filter_.statistics.mean_std(modality)[0]
        observations[modality] = torch.where(available, values, neutral)
    return Batch(
        observations=observations,
        controls=expand(batch.controls),
        states=expand(batch.states),
        contact=expand(batch.contact),
        previous=batch.previous.expand(len(has), -1),
        start=None if batch.start is None else batch.start.expand(len(has), -1),
        present=None if batch.present is None else expand(batch.present),
    )

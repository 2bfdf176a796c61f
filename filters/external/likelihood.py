"""Log-likelihoods of an external filter's measurement models at any states, for likelihood maps.

They come from ``Adapter.log_likelihood`` or, of a particle filter with torchfilter's interface, from its
``measurement_model`` and the models that this one fuses.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.calls import CPU, dtype_of, model_arguments, step_inputs
from beliefscope.filters.external.load import ExternalFilter


def has_likelihood(checkpoint: Checkpoint) -> bool:
    """Whether the measurement models of an external filter can be called."""
    if not isinstance(checkpoint, ExternalFilter) or (adapter := getattr(checkpoint, "adapter", None)) is None:
        return False
    return adapter.log_likelihood is not None or bool(_models(adapter.module))


@torch.no_grad()
def log_likelihood(
    checkpoint: ExternalFilter, episode: Episode, step: int, states: NDArray[np.float32], count: int
) -> NDArray[np.float32]:
    """(K + 1, C): of K measurement models and of the fused one at states (C, n), SI units, not normalised.

    Args:
        count: K; 0 or 1 for a filter with a single model.

    Raises:
        BadInput: the models fail, or return another shape or NaN.
    """
    adapter, place = checkpoint.adapter, f"{checkpoint.source} at the likelihood of step {step}"
    dtype = dtype_of(adapter.module)
    own = checkpoint.own_states(torch.from_numpy(states), dtype)
    observations, controls = step_inputs(checkpoint.task, adapter, episode, step, dtype)
    try:
        own_states, inputs = model_arguments(adapter, observations, controls, own)
        if adapter.log_likelihood is not None:
            values = torch.as_tensor(adapter.log_likelihood(own_states, inputs))
        else:
            # A model that fuses others comes last; one that fuses none is the only one.
            models = _models(adapter.module)
            values = torch.cat([model(states=own_states[None], observations=inputs) for model in models])
    except Exception as error:
        raise BadInput(f"{place} fails: {type(error).__name__}: {error}") from error
    values = _complete(values.detach().to(CPU).float(), count)
    if values.shape != (count + 1, len(states)) or bool(values.isnan().any()):
        problem = "NaN" if bool(values.isnan().any()) else f"shape {tuple(values.shape)}"
        raise BadInput(f"{place} returns {problem}, expected ({max(count, 1)}, {len(states)}) numbers")
    return values.numpy()


def _complete(values: Tensor, count: int) -> Tensor:
    """Adds the fused row: that of a single model is the same; that of several without one is their product."""
    if values.ndim != 2 or len(values) != max(count, 1) or count == 0:
        return values
    return torch.cat([values, values.sum(0, keepdim=True)])


def _models(filter_: Any) -> list[nn.Module]:
    """The measurement models of a particle filter with torchfilter's interface, the fused one last; else none."""
    model = getattr(filter_, "measurement_model", None)
    has_particles = hasattr(filter_, "num_particles") or hasattr(filter_, "particle_states")
    if not isinstance(model, nn.Module) or not has_particles:
        return []
    parts = getattr(model, "measurement_models", None)
    return [*parts, model] if isinstance(parts, nn.ModuleList) else [model]

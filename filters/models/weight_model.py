"""Weight model of crossmodal filters: the fusion weights beta from the observations of all modalities."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from beliefscope.datasets.task import Task
from beliefscope.filters.filter import Architecture, encoders
from beliefscope.filters.models.networks import Residual, Stack

MAX_LOGIT = 3.0
"""Bound of the weight model's logits: a weight of 0 or 1 would have no gradient."""


class WeightModel(nn.Module):
    """Crossmodal weights: the joined features of all modalities' encoders to log beta (T, N, K, W).

    A softmax over K makes the weights positive and sum to one in each component; bounded logits keep each between
    0.0025 and 0.9975.
    """

    def __init__(self, task: Task, architecture: Architecture, width: int) -> None:
        super().__init__()
        models, units = architecture.models, architecture.units
        self.shape = (len(models), width)
        modalities = dict.fromkeys(m for model in models for m in model.split("+"))
        self.encoders = encoders(task, modalities, architecture)
        # The published weight models: one residual block where there is a weight per component, three for a scalar.
        blocks = 3 if architecture.networks == "authors" and width == 1 else 1
        residuals = (Residual(units) for _ in range(blocks))
        self.trunk = Stack(nn.Linear(self.encoders.size, units), nn.ReLU(inplace=True), *residuals)
        self.output = nn.Linear(units, len(models) * width)
        nn.init.normal_(self.output.weight, std=1e-2)
        nn.init.zeros_(self.output.bias)

    def forward(self, observations: Mapping[str, Tensor]) -> Tensor:
        logits = self.output(self.trunk(self.encoders(observations))).unflatten(-1, self.shape)
        logits = MAX_LOGIT * torch.tanh(logits / MAX_LOGIT)
        return torch.log_softmax(logits, dim=-2)

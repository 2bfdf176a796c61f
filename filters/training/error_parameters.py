"""Calibration of an information filter: its error parameters from held-out episodes."""

from __future__ import annotations

import torch

from beliefscope.filters.batch import Steps
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.filters.training import losses
from beliefscope.filters.training.plan import Report

RATE = 0.1
"""Adam's learning rate: the parameters are few, and logarithms."""


def fit_errors(filter_: InformationFilter, steps: Steps, count: int, seed: int, report: Report | None = None) -> None:
    """Maximises the likelihood of the true states under the filter's estimates, over its ``error_parameters``.

    Args:
        steps: of episodes on which no sensor was trained: sensors are more accurate on those. count: steps of Adam.
        seed: of the first beliefs of tasks that start at the true state.
    """
    batch = steps.windows(steps.first, int(steps.length.min()))
    start = first_belief(filter_, batch)
    if not filter_.task.start_distance:
        start = losses.perturbed(start, torch.Generator(start.mean.device).manual_seed(seed))
    filter_.requires_grad_(False)
    evidence = filter_.encode(batch)
    parameters = filter_.error_parameters()
    for parameter in parameters:
        parameter.requires_grad_(True)
    optimiser = torch.optim.Adam(parameters, lr=RATE)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.1, total_iters=max(count, 1))
    for step in range(1, count + 1):
        optimiser.zero_grad()
        estimate = rollout(filter_, evidence, start, torch.Generator()).estimate
        error = losses.errors(filter_, estimate.mean, batch)
        loss = losses.negative_log_likelihood(error, estimate.covariance).mean()
        loss.backward()
        optimiser.step()
        schedule.step()
        if report is not None:
            report("calibration", step, count, float(loss.detach()))

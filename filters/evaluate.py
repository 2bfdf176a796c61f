"""Held-out accuracy and consistency of a filter."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import WHOLE, Faults
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.external.load import Foreign
from beliefscope.filters.filter import Filter
from beliefscope.filters.rollout import rollout, start_at_truth

LEFT_OUT = 30
"""First steps of each trajectory that do not count, as in the paper's evaluation."""

UNITS = {"m": ("cm", 100.0), "rad": ("deg", 180.0 / math.pi)}
"""Unit inside -> unit in reports and its factor."""

CHI2_95 = {1: 3.841, 2: 5.991, 3: 7.815, 4: 9.488}
"""95 % quantiles of the chi-square distribution by degrees of freedom."""


@dataclass(frozen=True)
class Metrics:
    """Over all counted steps of all episodes.

    Attributes:
        rmse: ``hinge_x_cm``, ``angle_deg``, ... and ``position_cm``, the root mean square of the distance on the map.
        nll: mean negative log-likelihood of the truth under the posterior Gaussian, in nats, m and rad.
        nees: mean normalised estimation error squared over n: 1 when consistent, more when over-confident.
        coverage95: share of steps whose truth lies in the 95 % ellipsoid.

    The last three are NaN, and null in JSON, for an estimator that gives no covariance.
    """

    rmse: dict[str, float]
    nll: float
    nees: float
    coverage95: float

    def to_dict(self) -> dict[str, Any]:
        of_covariance = {"nll": self.nll, "nees": self.nees, "coverage95": self.coverage95}
        return {"rmse": self.rmse} | {k: None if math.isnan(value) else value for k, value in of_covariance.items()}


def evaluate(
    filter_: Filter | Foreign,
    episodes: Sequence[Episode],
    *,
    faults: Faults = WHOLE,
    only: str | None = None,
    particles: int = 300,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Metrics:
    """Runs the filter over whole episodes, each started at the truth with covariance 0.1 I (standardised).

    Args:
        faults: how the sensors are broken. only: one modality's name: beta one-hot on it.
        particles: of this project's filters; one from outside has its own number.
        seed: of the filter's randomness and of the faults's.

    Raises:
        BadInput: no episode, one that does not fit the filter's task, or a faults or modality that does not.
    """
    if isinstance(filter_, Foreign) and only is not None:
        raise BadInput(f"only {only!r}: {filter_.source} is from outside, and cannot be told whom to follow")
    device = torch.device("cpu") if isinstance(filter_, Foreign) else next(filter_.parameters()).device
    broken = [faults.apply(episode, seed) for episode in episodes]
    steps = Steps.of(filter_.task, broken, device)
    groups: dict[int, list[int]] = {}
    for number, length in enumerate(steps.length.tolist()):
        groups.setdefault(length, []).append(number)
    errors, covariances = [], []
    for done, (length, members) in enumerate(sorted(groups.items())):
        if isinstance(filter_, Foreign):
            error, covariance = _run_foreign(filter_, [broken[number] for number in members], seed)
        else:
            error, covariance = run(filter_, steps.windows(steps.first[members], length), only, particles, seed)
        first = min(LEFT_OUT, length - 1)
        errors.append(error[first:].flatten(0, 1))
        covariances.append(covariance[first:].flatten(0, 1))
        if progress is not None:
            progress((done + 1) / len(groups))
    return metrics(filter_.task, torch.cat(errors), torch.cat(covariances))


@torch.no_grad()
def run(filter_: Filter, batch: Batch, only: str | None, particles: int, seed: int) -> tuple[Tensor, Tensor]:
    """Errors (T, N, n) and covariances (T, N, n, n) in SI units, on the CPU."""
    device = batch.states.device
    evidence = filter_.encode(batch)
    if only is not None:
        evidence = evidence.only(filter_.index(only))
    generator = torch.Generator(device).manual_seed(seed)
    estimate = rollout(filter_, evidence, start_at_truth(filter_, batch), generator, particles).estimate
    mean = filter_.statistics.state_to_si(estimate.mean)
    return (mean - batch.states).cpu(), filter_.statistics.covariance_to_si(estimate.covariance).cpu()


def _run_foreign(foreign: Foreign, episodes: Sequence[Episode], seed: int) -> tuple[Tensor, Tensor]:
    """As ``run``; covariances are NaN where the filter gives none."""
    values, _ = foreign.run(episodes, seed)
    mean = values["estimate_mean"]
    truth = torch.from_numpy(np.stack([episode.states for episode in episodes], axis=1))
    unknown = torch.full((*mean.shape, mean.shape[-1]), torch.nan)
    return mean - truth, values.get("estimate_covariance", unknown)


def metrics(task: Task, error: Tensor, covariance: Tensor) -> Metrics:
    """Metrics of errors (S, n) with covariances (S, n, n), SI units; covariances all NaN where there are none."""
    error, covariance = error.double(), covariance.double()
    rmse = {}
    for i, component in enumerate(task.components):
        unit, factor = UNITS[component.unit]
        rmse[f"{component.name}_{unit}"] = factor * float(error[:, i].square().mean().sqrt())
    rmse["position_cm"] = 100.0 * float(error[:, list(task.map_indices)].square().sum(-1).mean().sqrt())
    if covariance.isnan().all():
        return Metrics(rmse, math.nan, math.nan, math.nan)
    n = error.shape[-1]
    # A particle set that has collapsed onto one point has no inverse: a floor of (0.1 mm, 0.1 mrad)^2.
    covariance = covariance + 1e-8 * torch.eye(n, dtype=torch.float64)
    squared = (error.unsqueeze(-2) @ torch.linalg.solve(covariance, error.unsqueeze(-1))).flatten()
    nll = 0.5 * (squared + torch.linalg.slogdet(covariance).logabsdet + n * math.log(2 * math.pi))
    return Metrics(
        rmse=rmse,
        nll=float(nll.mean()),
        nees=float(squared.mean() / n),
        coverage95=float((squared <= CHI2_95[n]).double().mean()),
    )

"""Accuracy and consistency of a filter on held-out episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.special import chdtri
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Filter
from beliefscope.filters.rollout import rollout, start_at_truth

WARMUP = 30
"""First steps of each trajectory, which are excluded from metrics, as in the paper's evaluation."""

UNITS = {"m": ("cm", 100.0), "rad": ("deg", 180.0 / math.pi)}
"""Internal unit -> unit of reported values, and the conversion factor."""

CHI2_95 = {1: 3.841, 2: 5.991, 3: 7.815, 4: 9.488}
"""95 % quantiles of the chi-square distribution by degrees of freedom."""


@dataclass(frozen=True)
class Metrics:
    """Metrics over all evaluated steps of all episodes.

    Attributes:
        rmse: ``hinge_x_cm``, ``angle_deg``, ... and ``position_cm``, the root mean square distance on the map.
        nll: mean negative log-likelihood of the true state under the posterior Gaussian, in nats, m and rad.
        nees: mean normalised estimation error squared over n: 1 if consistent, more if overconfident.
        coverage95: share of steps whose true state lies in the 95 % ellipsoid.

    The last three are NaN, and null in JSON, for an estimator without a covariance.
    """

    rmse: dict[str, float]
    nll: float
    nees: float
    coverage95: float

    def to_dict(self) -> dict[str, Any]:
        consistency = {"nll": self.nll, "nees": self.nees, "coverage95": self.coverage95}
        return {"rmse": self.rmse} | {k: None if math.isnan(value) else value for k, value in consistency.items()}


def evaluate(
    filter_: Filter | ExternalFilter,
    episodes: Sequence[Episode],
    *,
    faults: Faults = NO_FAULTS,
    only: str | None = None,
    particles: int = 300,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Metrics:
    """Runs the filter over whole episodes, each from the true state with covariance 0.1 I (standardised).

    Args:
        faults: to inject into the sensors. only: name of a modality, whose beta is set one-hot.
        particles: number of particles; an external filter uses its own. seed: of the filter and of the faults.

    Raises:
        BadInput: there is no episode, or episodes, faults or modality do not fit the filter's task.
    """
    if isinstance(filter_, ExternalFilter) and only is not None:
        raise BadInput(f"only {only!r}: {filter_.source} is an external filter, whose weights cannot be set")
    device = torch.device("cpu") if isinstance(filter_, ExternalFilter) else next(filter_.parameters()).device
    episodes = [faults.apply(episode, seed) for episode in episodes]
    steps = Steps.from_episodes(filter_.task, episodes, device)
    groups: dict[int, list[int]] = {}
    for number, length in enumerate(steps.length.tolist()):
        groups.setdefault(length, []).append(number)
    errors, covariances = [], []
    for done, (length, members) in enumerate(sorted(groups.items()), 1):
        if isinstance(filter_, ExternalFilter):
            error, covariance = _run_external(filter_, [episodes[number] for number in members], seed)
        else:
            error, covariance = run(filter_, steps.windows(steps.first[members], length), only, particles, seed)
        first = min(WARMUP, length - 1)
        errors.append(error[first:].flatten(0, 1))
        covariances.append(covariance[first:].flatten(0, 1))
        if progress is not None:
            progress(done / len(groups))
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


def _run_external(external: ExternalFilter, episodes: Sequence[Episode], seed: int) -> tuple[Tensor, Tensor]:
    """As ``run``; covariances are NaN where the filter gives none."""
    values, _ = external.run(episodes, seed)
    mean = values["estimate_mean"]
    truth = torch.from_numpy(np.stack([episode.states for episode in episodes], axis=1))
    unknown = torch.full((*mean.shape, mean.shape[-1]), torch.nan)
    return mean - truth, values.get("estimate_covariance", unknown)


def metrics(task: Task, error: Tensor, covariance: Tensor) -> Metrics:
    """Metrics of errors (S, n) with covariances (S, n, n), SI units; covariances are all NaN if there are none."""
    error, covariance = error.double(), covariance.double()
    rmse = {}
    for i, component in enumerate(task.components):
        unit, factor = UNITS[component.unit]
        rmse[f"{component.name}_{unit}"] = factor * float(error[:, i].square().mean().sqrt())
    rmse["position_cm"] = 100.0 * float(error[:, list(task.map_indices)].square().sum(-1).mean().sqrt())
    if covariance.isnan().all():
        return Metrics(rmse, math.nan, math.nan, math.nan)
    n = error.shape[-1]
    # A floor of (0.1 mm, 0.1 mrad)^2: the covariance of a collapsed particle set has no inverse.
    covariance = covariance + 1e-8 * torch.eye(n, dtype=torch.float64)
    squared = (error.unsqueeze(-2) @ torch.linalg.solve(covariance, error.unsqueeze(-1))).flatten()
    nll = 0.5 * (squared + torch.linalg.slogdet(covariance).logabsdet + n * math.log(2 * math.pi))
    return Metrics(
        rmse=rmse,
        nll=float(nll.mean()),
        nees=float(squared.mean() / n),
        coverage95=float((squared <= CHI2_95[n]).double().mean()),
    )


def nees_bounds(n: int, trajectories: int) -> tuple[float, float]:
    """95 % interval of NEES / n of a consistent filter, averaged over independent trajectories at one step.

    The sum is chi-square distributed with n * trajectories degrees of freedom. Bar-Shalom, Li and Kirubarajan,
    Estimation with Applications to Tracking and Navigation, 5.4.2.
    """
    degrees = n * trajectories
    low, high = chdtri(degrees, [0.975, 0.025]) / degrees  # chdtri takes the upper tail's probability
    return float(low), float(high)

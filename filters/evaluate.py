"""Accuracy and consistency of a filter on held-out episodes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import chdtri
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.notebook_html import html_table
from beliefscope.datasets.task import Task
from beliefscope.filters.angles import Angles
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.covariance_floor import with_floor, without_invalid
from beliefscope.filters.engine import Engine, Progress, run_blocks
from beliefscope.filters.external.ablation import with_only
from beliefscope.filters.external.adapter import FailedStep
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.sequence import SequenceModel
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.filters.start_offset import NO_OFFSET, StartOffset, offset_start, shifted, without_start_offset
from beliefscope.filters.subsets import input_modalities, standalone_evidence

FILTER, STAY, DYNAMICS = "filter", "stay", "dynamics"
UPDATE, STANDALONE = "{}-only update", "{} standalone"

BASELINES = {
    STAY: "the start as the estimate of all steps",
    DYNAMICS: "the same filter with all observations masked",
}
"""Estimators that every filter must beat: name -> meaning."""

BLOCK = 64
"""Episodes that a filter runs over at a time. It determines the memory, and the random numbers of particle filters."""

FloatArray64 = NDArray[np.float64]

Member = TypeVar("Member", bound=tuple[Any, ...])
"""Number and episode, and perhaps more."""

Run = tuple[Tensor, Tensor]
"""Errors (T, N, n) and covariances (T, N, n, n) in SI units, on the CPU; of one episode without N."""

CONSISTENCY = {"nll": "NLL", "nees": "NEES/n", "coverage95": "95 % coverage"}
"""Measures of the belief in ``Metrics``: name -> label in tables and texts."""


@dataclass(frozen=True)
class Metrics:
    """Metrics over the evaluated steps of all episodes: those from ``Task.warmup`` on, unless stated otherwise.

    Attributes:
        rmse: ``hinge_x_cm``, ``angle_deg``, ... and that of ``Task.main_error``, such as ``position_cm``.
        nll: mean negative log-likelihood of the true state under the posterior Gaussian, in nats, m and rad.
        nees: mean normalised estimation error squared over n: 1 if consistent, more if overconfident.
        coverage95: share of steps whose true state lies in the 95 % ellipsoid.
        rmse_from_step_0: as ``rmse``, over all steps.
        rmse_before_contact, rmse_after_contact: as ``rmse``, before and from each episode's first contact; empty if
            there are no such steps.
        baselines: name in ``BASELINES`` -> its metrics; None for a filter that cannot run without observations.
        updates: modality -> metrics of its single-modality updates, which start at every step from the fused prior.
        standalone: modality -> metrics of the filter with the observations of this modality only; None for an
            external filter that fails without the others.
        squares: (R, 1 + keys of ``rmse``) of each episode: number of evaluated steps, sums of squared errors.

    ``nll``, ``nees`` and ``coverage95`` are of the steps with a covariance; NaN, and null in JSON, if there are none.
    """

    rmse: dict[str, float]
    nll: float
    nees: float
    coverage95: float
    rmse_from_step_0: dict[str, float] = field(default_factory=dict)
    rmse_before_contact: dict[str, float] = field(default_factory=dict)
    rmse_after_contact: dict[str, float] = field(default_factory=dict)
    baselines: Mapping[str, Metrics | None] = field(default_factory=dict)
    updates: Mapping[str, Metrics] = field(default_factory=dict)
    standalone: Mapping[str, Metrics | None] = field(default_factory=dict)
    squares: FloatArray64 = field(default_factory=lambda: np.zeros((0, 0)))

    def to_dict(self) -> dict[str, Any]:
        consistency = {name: getattr(self, name) for name in CONSISTENCY}
        document: dict[str, Any] = {"rmse": self.rmse}
        document |= {k: None if math.isnan(value) else value for k, value in consistency.items()}
        for key in ("rmse_from_step_0", "rmse_before_contact", "rmse_after_contact"):
            if getattr(self, key):
                document[key] = getattr(self, key)
        for key in ("baselines", "updates", "standalone"):
            if by_name := getattr(self, key):
                document[key] = {name: result and result._errors() for name, result in by_name.items()}
        return document

    def __str__(self) -> str:
        parts = [f"RMSE {key} {value:.3g}" for key, value in self.rmse.items()]
        parts += [f"{label} {getattr(self, name):.3g}" for name, label in CONSISTENCY.items()]
        return ", ".join(parts)

    def _repr_html_(self) -> str:
        """Errors beside those of the baselines, and the measures of consistency, in a notebook."""
        columns = {FILTER: self, **{name: baseline for name, baseline in self.baselines.items() if baseline}}
        rows = [[f"RMSE {key}", *(m.rmse.get(key) for m in columns.values())] for key in self.rmse]
        rows += [[label, getattr(self, name), *[None] * (len(columns) - 1)] for name, label in CONSISTENCY.items()]
        return html_table("", ["measure", *columns], rows)

    def _errors(self) -> dict[str, Any]:
        return {"rmse": self.rmse, "rmse_from_step_0": self.rmse_from_step_0}


def evaluate(
    filter_: Filter | ExternalFilter,
    episodes: Sequence[Episode],
    *,
    faults: Faults = NO_FAULTS,
    only: str | None = None,
    particles: int = 300,
    seed: int = 0,
    start_offset: StartOffset = NO_OFFSET,
    baselines: bool = False,
    modalities: bool = False,
    engine: Engine = "local",
    workers: int = 1,
    progress: Progress = None,
) -> Metrics:
    """Runs the filter over whole episodes, each from its first belief (``rollout.first_belief``).

    Args:
        faults: to inject into the sensors. only: name of a modality: its standalone filter.
        particles: number of particles; an external filter uses its own. seed: of filter, faults and start offsets.
        start_offset: of the first belief from the true state; its covariance matches the offset. Default: as the task.
        baselines: whether to evaluate ``BASELINES`` as well, with the same starts, faults and random numbers.
        modalities: whether to evaluate the single-modality updates and standalone filters as well, in the same way.
            An external filter runs without information of the others' sensors (``external/ablation.py``).
        engine, workers: where to run, as for ``filters.engine.run_blocks``. The values do not depend on them.

    Warns if covariances of an external filter are not symmetric and positive definite; they count as unknown.

    Raises:
        BadInput: there is no episode; episodes, faults or modality do not fit the filter's task; or there are several
            workers for an external filter that has no build function.
    """
    faults.check(filter_.task, max(map(len, episodes), default=0))
    offsets = torch.from_numpy(start_offset.vectors(filter_.task, episodes, seed))
    members = list(zip(range(len(episodes)), episodes, offsets, strict=True))
    block_runs = partial(
        _block_runs,
        filter_,
        faults=faults,
        only=only,
        particles=particles,
        seed=seed,
        start_offset=start_offset,
        baselines=baselines,
        modalities=modalities,
    )
    runs: dict[str, dict[int, Run]] = {}
    for block, results in run_blocks(block_runs, blocks_of(members), engine, workers, progress):
        for name, (error, covariance) in results.items():
            pairs = zip(torch.from_numpy(error).unbind(1), torch.from_numpy(covariance).unbind(1), strict=True)
            runs.setdefault(name, {}).update(zip((number for number, *_ in block), pairs, strict=True))
    complete = {name: [by[i] for i in range(len(by))] for name, by in runs.items() if len(by) == len(episodes)}
    if isinstance(filter_, ExternalFilter):
        errors, covariances = zip(*complete[FILTER], strict=True)
        firsts = [filter_.task.first_counted(len(error)) for error in errors]
        complete[FILTER] = [*zip(errors, without_invalid(covariances, firsts), strict=True)]
    pooled = {name: _pool(filter_.task, by, episodes) for name, by in complete.items()}
    names = filter_.task.modalities if isinstance(filter_, ExternalFilter) else input_modalities(filter_)
    return replace(
        pooled[FILTER],
        baselines={name: pooled.get(name) for name in BASELINES} if baselines else {},
        updates={name: pooled[UPDATE.format(name)] for name in names if UPDATE.format(name) in pooled},
        standalone={name: pooled.get(STANDALONE.format(name)) for name in names} if modalities else {},
    )


def blocks_of(members: Sequence[Member]) -> list[list[Member]]:
    """Blocks of members whose episodes have equal lengths, shortest first. Raises BadInput if there are none."""
    if not members:
        raise BadInput("no episodes: the data set's split is empty")
    by_length: dict[int, list[Member]] = {}
    for member in members:
        by_length.setdefault(len(member[1]), []).append(member)
    return [same[i : i + BLOCK] for _, same in sorted(by_length.items()) for i in range(0, len(same), BLOCK)]


def _block_runs(
    filter_: Filter | ExternalFilter,
    block: Sequence[tuple[int, Episode, Tensor]],
    progress: Progress,
    *,
    faults: Faults,
    only: str | None,
    particles: int,
    seed: int,
    start_offset: StartOffset,
    baselines: bool,
    modalities: bool,
) -> dict[str, tuple[NDArray[Any], NDArray[Any]]]:
    """The runs over a block of equally long episodes, each with the offset of its start, as arrays for other processes.

    Arguments as for ``evaluate``.
    """
    device = torch.device("cpu") if isinstance(filter_, ExternalFilter) else next(filter_.parameters()).device
    offsets = torch.stack([offset for *_, offset in block]).to(device)
    variances = torch.from_numpy(start_offset.variances(filter_.task)).to(device)
    episodes = [faults.apply(episode, seed) for _, episode, _ in block]
    if start_offset:
        episodes = [without_start_offset(episode) for episode in episodes]
    steps = Steps.from_episodes(filter_.task, episodes, device)
    if isinstance(filter_, ExternalFilter):
        start = shifted(filter_.start(episodes), offsets, variances)
        runs = _external_runs(filter_, episodes, start, only, seed, modalities)
    else:
        batch = steps.windows(steps.first, len(episodes[0]))
        start = offset_start(filter_, batch, offsets, variances)
        runs = _filter_runs(filter_, batch, start, only, particles, seed, baselines, modalities, progress)
    return {name: (error.numpy(), covariance.numpy()) for name, (error, covariance) in runs.items()}


def run(filter_: Filter, batch: Batch, only: str | None, particles: int, seed: int) -> Run:
    """Errors and covariances of a run from the first belief."""
    return _filter_runs(filter_, batch, first_belief(filter_, batch), only, particles, seed)[FILTER]


@torch.no_grad()
def _filter_runs(
    filter_: Filter,
    batch: Batch,
    start: Gaussian,
    only: str | None,
    particles: int,
    seed: int,
    baselines: bool = False,
    modalities: bool = False,
    progress: Progress = None,
) -> dict[str, Run]:
    """The runs of the filter and, if requested, of its baselines and modalities, from the same start."""
    evidence = filter_.encode(batch)
    by_name = {FILTER: evidence if only is None else standalone_evidence(filter_, batch, evidence, only)}
    for name in input_modalities(filter_) if modalities else ():
        by_name[STANDALONE.format(name)] = standalone_evidence(filter_, batch, evidence, name)
    if baselines and not isinstance(filter_, SequenceModel):
        by_name[DYNAMICS] = evidence.select_models(torch.zeros_like(evidence.observation[..., 0], dtype=torch.bool))
    runs = {}
    for done, (name, selected) in enumerate(by_name.items(), 1):
        generator = torch.Generator(batch.states.device).manual_seed(seed)
        result = rollout(filter_, selected, start, generator, particles, updates=modalities and name == FILTER)
        runs[name] = _si_run(filter_, batch, result.estimate)
        if result.updates is not None:
            updates = zip(result.updates.mean.unbind(2), result.updates.covariance.unbind(2), strict=True)
            for model, moments in zip(filter_.names, updates, strict=True):
                runs[UPDATE.format(model)] = _si_run(filter_, batch, Gaussian(*moments))
        if progress is not None:
            progress(done / len(by_name))
    mean = filter_.statistics.state_to_si(start.mean)
    return runs | {STAY: _stay(filter_.task, mean.cpu(), batch.states.cpu())}


def _si_run(filter_: Filter, batch: Batch, estimate: Gaussian) -> Run:
    """Errors and covariances of standardised estimates (T, N, n), (T, N, n, n)."""
    si = filter_.statistics
    return (si.state_to_si(estimate.mean) - batch.states).cpu(), si.covariance_to_si(estimate.covariance).cpu()


def _external_runs(
    external: ExternalFilter,
    episodes: Sequence[Episode],
    start: Gaussian,
    only: str | None,
    seed: int,
    modalities: bool,
) -> dict[str, Run]:
    """As ``_filter_runs``; covariances are NaN where the filter gives none. Standalone filters that fail are absent."""
    truth = torch.from_numpy(np.stack([episode.states for episode in episodes], axis=1))
    used = {FILTER: only} | {STANDALONE.format(name): name for name in external.task.modalities if modalities}
    runs = {}
    for run_name, modality in used.items():
        if modality is not None:
            check_name(f"modality of task {external.task.name!r}", modality, external.task.modalities)
        kept = None if modality is None else (modality,)
        seen = [with_only(episode, kept, external.adapter.absent) for episode in episodes]
        try:
            values, names = external.run(seen, seed, start=start)
        except FailedStep:
            if run_name == FILTER:
                raise
            continue
        runs[run_name] = external_run(external.task, values, truth)
        if run_name == FILTER and modalities and "modality_mean" in values:
            for k, name in enumerate(names):
                moments = {"estimate_mean": values["modality_mean"][:, :, k]}
                runs[UPDATE.format(name)] = external_run(external.task, moments, truth)
    return runs if start.mean.isnan().any() else runs | {STAY: _stay(external.task, start.mean, truth)}


def external_run(task: Task, values: Mapping[str, Tensor], truth: Tensor) -> Run:
    """Errors, float64, of the estimates of an external filter (``ExternalFilter.run``), and its covariances or NaN.

    truth: (T, N, n). Angles are wrapped to -pi..pi, rotations as in ``Task.difference``.
    """
    mean = values["estimate_mean"]
    unknown = torch.full((*mean.shape, mean.shape[-1]), torch.nan)
    return _errors(task, mean, truth), values.get("estimate_covariance", unknown)


def _errors(task: Task, mean: Tensor, truth: Tensor) -> Tensor:
    return torch.from_numpy(task.difference(mean.numpy(), truth.numpy()))


def _stay(task: Task, mean: Tensor, states: Tensor) -> Run:
    """The run of an estimator that keeps the start (N, n) as its estimate of the states (T, N, n)."""
    return _errors(task, mean, states), torch.full((*states.shape, states.shape[-1]), torch.nan)


def _pool(task: Task, trajectories: Sequence[Run], episodes: Sequence[Episode]) -> Metrics:
    """Metrics of errors (T, n) and covariances (T, n, n), SI units, of each episode."""
    # An estimate that counts turns has no larger errors.
    angles = Angles(task.angles)
    trajectories = [(angles.wrapped(e), c) for e, c in trajectories]
    late = [(e[first:], c[first:]) for e, c in trajectories for first in [task.first_counted(len(e))]]
    result = metrics(task, torch.cat([e for e, _ in late]), torch.cat([c for _, c in late]))
    sums = [[float(len(e)), *(float(values.sum()) for values in squares(task, e).values())] for e, _ in late]
    everything = squares(task, torch.cat([e for e, _ in trajectories]))
    has_contact = "contact" in task.covariates
    touched = np.concatenate([np.maximum.accumulate(e.contact)[task.first_counted(len(e)) :] for e in episodes])
    late_errors = squares(task, torch.cat([e for e, _ in late]))
    before, after = (
        _root_mean({key: values[mask] for key, values in late_errors.items()}) for mask in (~touched, touched)
    )
    return replace(
        result,
        rmse_from_step_0=_root_mean(everything),
        rmse_before_contact=before if has_contact and not touched.all() else {},
        rmse_after_contact=after if has_contact and touched.any() else {},
        squares=np.array(sums),
    )


def squares(task: Task, error: Tensor) -> dict[str, Tensor]:
    """Squares (S,) of errors (S, n) in SI units, by key of ``Metrics.rmse`` and in its units."""
    error = error.double()
    by_component = {c.key: (c.conversion[1] * error[:, i]).square() for i, c in enumerate(task.components)}
    main = task.main_error
    return by_component | {main.key: (main.factor * error[:, list(main.indices)]).square().sum(-1)}


def _root_mean(squares: Mapping[str, Tensor]) -> dict[str, float]:
    return {key: float(values.mean().sqrt()) for key, values in squares.items()}


def metrics(task: Task, error: Tensor, covariance: Tensor) -> Metrics:
    """Metrics of errors (S, n) with covariances (S, n, n), SI units; unknown covariances are NaN."""
    error, covariance = error.double(), covariance.double()
    rmse = _root_mean(squares(task, error))
    known = ~covariance.isnan().any((-2, -1))
    if not known.any():
        return Metrics(rmse, math.nan, math.nan, math.nan)
    error, covariance = error[known], covariance[known]
    n = error.shape[-1]
    covariance = torch.from_numpy(with_floor(covariance.numpy()))
    squared = (error.unsqueeze(-2) @ torch.linalg.solve(covariance, error.unsqueeze(-1))).flatten()
    nll = 0.5 * (squared + torch.linalg.slogdet(covariance).logabsdet + n * math.log(2 * math.pi))
    return Metrics(
        rmse=rmse,
        nll=float(nll.mean()),
        nees=float(squared.mean() / n),
        coverage95=float((squared <= chdtri(n, 0.05)).double().mean()),
    )


def nees_bounds(n: int, trajectories: int) -> tuple[float, float]:
    """95 % interval of NEES / n of a consistent filter, averaged over independent episodes at one step.

    The sum is chi-square distributed with n * episodes degrees of freedom. Bar-Shalom, Li and Kirubarajan,
    Estimation with Applications to Tracking and Navigation, 5.4.2.
    """
    degrees = n * trajectories
    low, high = chdtri(degrees, [0.975, 0.025]) / degrees  # chdtri takes the upper tail's probability
    return float(low), float(high)

"""The paper's published filters for the door, from a folder with clones of their two repositories, beside ours.

``torchfilter`` and ``multimodalfilter`` (both MIT) stay outside of this project; docs/filters.md has their addresses
and the packages they need. Ours and theirs run alternately in one process and thread, and count CPU time.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

import torch
from arithmetic import Flops, count, cpu_seconds, measure_rate, spread
from torch import nn

from beliefscope.filters.batch import Batch
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.pf import MixtureParticleFilter

REPOSITORIES = {
    "torchfilter": "https://github.com/stanford-iprl-lab/torchfilter",
    "multimodalfilter": "https://github.com/brentyi/multimodalfilter",
}
CLASSES = {"crossmodal-pf": "DoorCrossmodalParticleFilter", "crossmodal-ekf": "DoorCrossmodalKalmanFilter"}
NETWORKS = ("published", "authors", "default")
REPETITIONS = 7

Call = Callable[[Any, Batch], object]


@dataclass(frozen=True)
class Workload:
    """A batch, and how it runs through one of our filters and through a published one."""

    name: str
    batch: Batch
    ours: Call
    published: Call

    @property
    def steps(self) -> int:
        """Trajectory-steps."""
        return int(self.batch.states.shape[0] * self.batch.states.shape[1])


def load(folder: Path) -> Any:
    """The module with the published door filters. Exits with a message if a repository or a package is missing."""
    for name, address in REPOSITORIES.items():
        if not (folder / name).is_dir():
            sys.exit(f"{str(folder)!r} has no folder {name!r}: clone {address} into it")
        sys.path.insert(0, str(folder / name))
    try:
        return importlib.import_module("crossmodal.door_models")
    except ModuleNotFoundError as error:
        sys.exit(f"the published code needs the package {error.name!r}: see docs/filters.md, section Speed")


def observations(batch: Batch) -> dict[str, torch.Tensor]:
    """As the published filters take them: standardised images, effector positions, other sensors."""
    images = (batch.observations["image"].float() - 127.5) / 74.0
    position, sensors = batch.observations["haptics"].split([3, 7], dim=-1)
    return {"image": images, "gripper_pos": position, "gripper_sensors": sensors}


def initialise(filter_: Any, batch: Batch, training: bool) -> None:
    """Training mode has 30 particles, evaluation 300."""
    filter_.train(training)
    covariance = 0.1 * torch.eye(3).expand(len(batch.previous), 3, 3)
    filter_.initialize_beliefs(mean=batch.previous, covariance=covariance)


@torch.no_grad()
def published_forward(filter_: Any, batch: Batch) -> None:
    initialise(filter_, batch, training=False)
    filter_.forward_loop(observations=observations(batch), controls=batch.controls)


def published_backward(filter_: Any, batch: Batch) -> None:
    filter_.zero_grad(set_to_none=True)
    initialise(filter_, batch, training=True)
    mean = filter_.forward_loop(observations=observations(batch), controls=batch.controls)
    (mean - batch.states).square().mean().backward()


def compare(name: str, published: nn.Module, workloads: list[Workload]) -> list[tuple[str, ...]]:
    """Rows of (quantity, published, ours with authors' networks, ours with default networks)."""
    filters: dict[str, Any] = {"published": published}
    filters |= {networks: build(architecture("door", name, networks)) for networks in NETWORKS[1:]}
    batch = workloads[0].batch
    weights = {key: trained_values(filter_) for key, filter_ in filters.items()}
    networks = {key: networks_flops(filter_, batch) for key, filter_ in filters.items()}
    rows: list[tuple[str, ...]] = [
        ("trained weights and biases", *(f"{weights[key]:,}" for key in NETWORKS)),
        (
            "operations of all networks, one input each (10^6)",
            *(f"{networks[key].total / 1e6:.3f}" for key in NETWORKS),
        ),
    ]
    for workload in workloads:
        rows += _measure(workload, filters)
    return rows


def _measure(workload: Workload, filters: dict[str, Any]) -> list[tuple[str, ...]]:
    def call(key: str) -> Callable[[], object]:
        run = workload.published if key == "published" else workload.ours
        return lambda: run(filters[key], workload.batch)

    flops = {key: executed(call(key)) for key in NETWORKS}
    seconds: dict[str, list[float]] = {key: [] for key in NETWORKS}
    multiples: dict[str, list[float]] = {key: [] for key in NETWORKS}
    for _ in range(REPETITIONS):
        rate = measure_rate()
        for key in NETWORKS:
            seconds[key].append(cpu_seconds(call(key)))
            multiples[key].append(seconds[key][-1] / rate.seconds(flops[key]))
    n, name = workload.steps, workload.name
    ratios = {key: [a / b for a, b in zip(seconds["published"], seconds[key], strict=True)] for key in NETWORKS}
    return [
        (f"{name}: operations a step (10^6)", *(f"{flops[key].total / n / 1e6:.1f}" for key in NETWORKS)),
        (f"{name}: CPU ms a step", *(f"{1e3 * median(seconds[key]) / n:.3g}" for key in NETWORKS)),
        (f"{name}: times the floor", *(spread(multiples[key]) for key in NETWORKS)),
        (f"{name}: published / ours", "", *(spread(ratios[key]) for key in NETWORKS[1:])),
    ]


def trained_values(filter_: Any) -> int:
    """Number of weights and biases. The process noise, fixed in the published code, is left out, and so is the second
    copy of the dynamics in the published Kalman filter: ours have one for all modalities."""
    if isinstance(filter_, Filter):
        return sum(p.numel() for key, p in filter_.named_parameters() if key != "dynamics.log_noise")
    copies = getattr(filter_, "filter_models", [None])[1:]
    skipped = {id(p) for copy in copies for p in copy.dynamics_model.parameters()}
    return sum(p.numel() for p in filter_.parameters() if p.requires_grad and id(p) not in skipped)


def executed(run: Callable[[], object]) -> Flops:
    """Operations of a run, all of it in PyTorch: those of NumPy are not counted."""
    with patch.object(ExtendedKalmanFilter, "single_trajectory", return_value=None):
        return count(run)


@torch.no_grad()
def networks_flops(filter_: Any, batch: Batch) -> Flops:
    """Each network once: of one trajectory and step, with one state."""
    step = Batch(
        {key: value[:1, :1] for key, value in batch.observations.items()},
        batch.controls[:1, :1],
        batch.states[:1, :1],
        batch.contact[:1, :1],
        batch.previous[:1],
    )
    return count(lambda: _ours_once(filter_, step) if isinstance(filter_, Filter) else _published_once(filter_, step))


def _ours_once(filter_: Filter, step: Batch) -> None:
    evidence = filter_.encode(step)[0]
    filter_.dynamics(step.previous, evidence.control)
    if isinstance(filter_, MixtureParticleFilter):
        filter_.log_likelihood(evidence, step.previous.unsqueeze(1))


def _published_once(filter_: Any, step: Batch) -> None:
    observed = {key: value[0] for key, value in observations(step).items()}
    filters = getattr(filter_, "filter_models", [filter_])
    filters[0].dynamics_model(initial_states=step.previous, controls=step.controls[0])
    if hasattr(filter_, "filter_models"):
        for part in filters:
            part.virtual_sensor_model(observations=observed)
        filter_.crossmodal_weight_model(observations=observed)
    else:
        filter_.measurement_model(states=step.previous.unsqueeze(1), observations=observed)


def published_filters(folder: Path) -> dict[str, nn.Module]:
    models = load(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.cholesky is deprecated.
        return {name: getattr(models, class_)() for name, class_ in CLASSES.items()}

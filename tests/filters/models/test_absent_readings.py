"""Steps without a reading of a sensor do not update the built-in filters (``Task.masks``)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.catalog import architecture, build, filters_of
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.filters.rollout import Rollout, first_belief, rollout
from beliefscope.filters.subsets import standalone_evidence
from beliefscope.filters.training import losses

STEPS, GAP = 30, slice(12, 30)
TASK = Task(
    name="cart",
    components=(Component("x", "m"), Component("y", "m")),
    observations={"gps": (2,), "speed": (1,), "bearing": (2,)},
    modalities={"gps": ("gps", "speed"), "radio": ("bearing",)},
    control_size=1,
    dt=0.1,
    covariates={"fix": Covariate("boolean"), "moves": Covariate("boolean"), "signal": Covariate("boolean")},
    masks={"gps": "fix", "speed": "moves", "bearing": "signal"},
    warmup=0,
)
NAMES = [name for name, a in filters_of(TASK).items() if a.kind not in ("lstm", "transformer")]


def episode(seed: int = 0, **absent: slice) -> Episode:
    """Random numbers; readings of the covariates' sensors are absent at some steps."""
    rng = np.random.default_rng(seed)
    covariates = {name: np.ones(STEPS, np.float32) for name in TASK.covariates}
    for name, steps in absent.items():
        covariates[name][steps] = 0.0
    return Episode(
        task=TASK,
        states=0.1 * rng.standard_normal((STEPS, 2)).cumsum(0),
        controls=rng.standard_normal((STEPS, 1)),
        observations={key: rng.standard_normal((STEPS, *shape)) for key, shape in TASK.observations.items()},
        covariates=covariates,
    )


def batch_of(episode: Episode, task: Task = TASK) -> Batch:
    return Steps.from_episodes(task, [replace(episode, task=task)]).episode(0)


def run(filter_: Filter, batch: Batch, modality: str = "") -> Rollout:
    evidence = filter_.encode(batch)
    if modality:
        evidence = standalone_evidence(filter_, batch, evidence, modality)
    start = first_belief(filter_, batch)
    return rollout(filter_, evidence, start, torch.Generator().manual_seed(0), 50, keep=True)


def equal(a: Gaussian, b: Gaussian, at: slice = slice(None)) -> bool:
    return torch.equal(a.mean[at], b.mean[at]) and torch.equal(a.covariance[at], b.covariance[at])


@pytest.mark.first(4)
@pytest.mark.parametrize("name", NAMES)
def test_repeated_readings_are_not_used(name: str) -> None:
    filter_ = build(architecture(TASK, name))
    full, gap = episode(), episode(fix=GAP, moves=GAP)
    other = replace(gap, observations={key: value.copy() for key, value in gap.observations.items()})
    for key in ("gps", "speed"):
        other.observations[key][GAP] = 5.0
    first, second, used = (run(filter_, batch_of(e)).estimate for e in (gap, other, full))
    assert equal(first, used, slice(GAP.start))
    if filter_.names == ("gps+radio",):  # a joint model updates while its other modality has readings
        assert equal(first, used)
        return
    # The weight model reads repeated readings, but the only model left has all of the weight, up to rounding.
    torch.testing.assert_close(first.mean, second.mean)
    torch.testing.assert_close(first.covariance, second.covariance)
    assert equal(first, used) == (filter_.names == ("radio",))


@pytest.mark.first(4)
@pytest.mark.parametrize("name", NAMES)
def test_without_any_reading_the_belief_is_predicted(name: str) -> None:
    filter_ = build(architecture(TASK, name))
    steps = run(filter_, batch_of(episode(fix=GAP, moves=GAP, signal=GAP))).steps
    other = batch_of(episode(1, fix=GAP, moves=GAP, signal=GAP))
    blind = replace(batch_of(episode()), present=other.present)
    for t in range(GAP.start, STEPS):
        evidence = filter_.encode(blind)[t]
        assert evidence.present is not None
        assert not evidence.present.any()
    for step in steps[GAP]:
        predicted = step.predicted
        if isinstance(predicted, Gaussian) and predicted.mean.ndim == 3:
            for k in range(predicted.mean.shape[1]):
                torch.testing.assert_close(step.modality.mean[:, k], predicted.mean[:, k])  # type: ignore[union-attr]


def test_a_modality_has_a_reading_if_any_of_its_sensors_has_one() -> None:
    batch = batch_of(episode(fix=slice(5, 10), moves=slice(8, 12), signal=slice(20, 21)))
    assert batch.present is not None
    absent = [(~batch.present[:, 0, k]).nonzero().flatten().tolist() for k in range(2)]
    assert absent == [[8, 9], [20]]
    assert batch_of(episode(), replace(TASK, masks={})).present is None


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf", "information-ekf"])
def test_present_readings_are_used_as_without_masks(name: str) -> None:
    filter_ = build(architecture(TASK, name))
    masked, plain = batch_of(episode()), batch_of(episode(), replace(TASK, masks={}))
    # Models are selected although all are present, which rounds the weights differently.
    torch.testing.assert_close(run(filter_, masked).estimate.mean, run(filter_, plain).estimate.mean)


def test_a_standalone_filter_predicts_without_its_readings() -> None:
    filter_ = build(architecture(TASK, "crossmodal-ekf"))
    gap, other = (batch_of(episode(seed, fix=GAP, moves=GAP)) for seed in (0, 1))
    other = replace(
        gap,
        observations=gap.observations
        | {"gps": torch.cat([gap.observations["gps"][:12], other.observations["gps"][12:]])},
    )
    assert equal(run(filter_, gap, "gps").estimate, run(filter_, other, "gps").estimate)


def test_training_of_sensors_skips_repeated_readings() -> None:
    gap = batch_of(episode(fix=GAP, moves=GAP))
    readings = gap.observations["gps"].clone()
    readings[GAP] = 5.0
    other = replace(gap, observations=gap.observations | {"gps": readings})
    information, particles = (build(architecture(TASK, name)) for name in ("information-ekf", "crossmodal-pf"))
    assert isinstance(information, InformationFilter)
    assert isinstance(particles, MixtureParticleFilter)

    def values(batch: Batch) -> list[float]:
        noise = torch.Generator().manual_seed(0)
        model = particles.measurement_model("gps")
        losses_ = losses.sensor_likelihood(information, "gps", batch), losses.likelihood(particles, model, batch, noise)
        return [loss.item() for loss in losses_]

    all_present = replace(other, present=None)
    assert values(gap)[1] == values(other)[1]
    assert values(gap)[1] != values(all_present)[1]
    sensed = losses.with_readings(information, "gps", gap, gap.states)
    assert torch.equal(sensed, gap.states[: GAP.start].flatten(0, 1))
    none = replace(gap, present=torch.zeros_like(gap.present))  # type: ignore[arg-type]
    assert losses.with_readings(information, "gps", none, gap.states) is gap.states
    assert np.isfinite(values(none)).all()


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith(("crossmodal", "information"))])
def test_weight_of_an_absent_model_only_is_no_update(name: str) -> None:
    filter_ = build(architecture(TASK, name))
    batch = batch_of(episode(fix=GAP, moves=GAP))
    evidence = filter_.encode(batch).only(filter_.names.index("gps"))
    assert evidence.present is not None
    assert not evidence.present[GAP].any()
    result = rollout(filter_, evidence, first_belief(filter_, batch), torch.Generator().manual_seed(0), 50)
    assert result.estimate.mean.isfinite().all()
    blind = replace(batch, observations={key: values + 1.0 for key, values in batch.observations.items()})
    blind = replace(
        blind,
        observations={
            key: torch.cat([batch.observations[key][: GAP.start], values[GAP]])
            for key, values in blind.observations.items()
        },
    )
    other = filter_.encode(blind).only(filter_.names.index("gps"))
    changed = rollout(filter_, other, first_belief(filter_, batch), torch.Generator().manual_seed(0), 50)
    assert equal(result.estimate, changed.estimate)

"""The information filter: equal to the Kalman filter, invariant to translation, and calibrated stage by stage."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.batch import Batch, Steps, shift_positions
from beliefscope.filters.belief import Evidence, Gaussian
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.models.ekf import predict
from beliefscope.filters.models.fusion import powers, product_of_experts, weighted_product
from beliefscope.filters.models.information import HISTORY, InformationFilter, recent_steps
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.filters.subsets import standalone_evidence
from beliefscope.filters.training.losses import sensor_likelihood
from beliefscope.filters.training.plan import PLANS
from beliefscope.filters.training.stages import Trainer

N, STEPS = 3, 12


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    task = find_task("door-field")
    assert task.simulate is not None
    return [task.simulate(2, index, STEPS + 8) for index in range(N)]


@pytest.fixture(scope="module")
def filter_(episodes: list[Episode]) -> InformationFilter:
    built = build(architecture("door-field", "information-ekf"), seed=0)
    assert isinstance(built, InformationFilter)
    torch.manual_seed(1)
    for module in (built.dynamics.output, built.weight_model.output):
        nn.init.normal_(module.weight, std=0.5)
    built.statistics.fit(Steps.from_episodes(built.task, episodes))
    return built.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def batch(filter_: InformationFilter, episodes: list[Episode]) -> Batch:
    steps = Steps.from_episodes(filter_.task, episodes)
    return steps.windows(steps.first, STEPS)


def kalman_update(prior: Gaussian, z: Tensor, r: Tensor) -> Gaussian:
    """Textbook update with K stacked observations of the whole state. z: (K, n), r: (K, n, n)."""
    k, n = z.shape
    h = torch.eye(n, dtype=torch.float64).repeat(k, 1)
    gain = prior.covariance @ h.T @ torch.linalg.inv(h @ prior.covariance @ h.T + torch.block_diag(*r))
    mean = prior.mean + gain @ (z.flatten() - h @ prior.mean)
    return Gaussian(mean, (torch.eye(n, dtype=torch.float64) - gain @ h) @ prior.covariance)


def test_equal_weights_give_the_kalman_filter_with_stacked_measurements(
    filter_: InformationFilter, batch: Batch
) -> None:
    filter_ = build(filter_.architecture, seed=3).double().eval()  # type: ignore[assignment]
    evidence = filter_.encode(batch)
    assert evidence.log_weights is not None
    assert evidence.noise is not None
    evidence = replace(evidence, log_weights=torch.zeros_like(evidence.log_weights) - torch.log(torch.tensor(2.0)))
    start = first_belief(filter_, batch)
    estimate = rollout(filter_, evidence, start, torch.Generator()).estimate
    for i in range(N):
        belief = Gaussian(start.mean[i], start.covariance[i])
        for t in range(STEPS):
            mean, jacobian = filter_.dynamics.with_jacobian(belief.mean, evidence.control[t, i])
            prior = predict(belief, mean, jacobian, filter_.dynamics.noise)
            belief = kalman_update(prior, evidence.observation[t, i], torch.diag_embed(evidence.noise[t, i] ** 2))
            torch.testing.assert_close(estimate.mean[t, i], belief.mean)
            torch.testing.assert_close(estimate.covariance[t, i], belief.covariance)


def test_powers() -> None:
    log_weights = torch.log_softmax(torch.randn(4, 3, 2), dim=1)
    torch.testing.assert_close(powers(log_weights).sum(1), torch.full((4, 2), 3.0))
    torch.testing.assert_close(powers(torch.zeros(4, 3, 2)), torch.ones(4, 3, 2))
    one_hot = torch.full((1, 3, 2), -torch.inf)
    one_hot[:, 1] = 0.0
    torch.testing.assert_close(powers(one_hot)[0, :, 0], torch.tensor([0.0, 1.0, 0.0]))
    assert (powers(log_weights, torch.zeros(4, 3, dtype=torch.bool)) == 0).all()


def test_product_to_the_power_of_one_is_the_product_of_experts() -> None:
    root = torch.randn(4, 3, 2, 2, dtype=torch.float64)
    bank = Gaussian(torch.randn(4, 3, 2, dtype=torch.float64), root @ root.mT + torch.eye(2))
    expected = product_of_experts(bank)
    result = weighted_product(bank, torch.ones(4, 3, 2, dtype=torch.float64))
    torch.testing.assert_close(result.mean, expected.mean)
    torch.testing.assert_close(result.covariance, expected.covariance)
    doubled = weighted_product(bank, torch.full((4, 3, 2), 2.0, dtype=torch.float64))
    torch.testing.assert_close(doubled.covariance, expected.covariance / 2)


def test_without_any_model_the_belief_is_only_predicted(filter_: InformationFilter, batch: Batch) -> None:
    evidence = filter_.encode(batch).select_models(torch.zeros(STEPS, N, 2, dtype=torch.bool))
    belief = filter_.start(first_belief(filter_, batch), 0, torch.Generator())
    posterior, trace = filter_.step(belief, evidence[0], torch.Generator())
    assert isinstance(trace.predicted, Gaussian)
    torch.testing.assert_close(posterior.mean, trace.predicted.mean)
    torch.testing.assert_close(posterior.covariance, trace.predicted.covariance, rtol=1e-4, atol=1e-6)


def test_standalone_filter_is_the_update_with_one_sensor(filter_: InformationFilter, batch: Batch) -> None:
    """Once, from the same prior: later steps differ, since the standalone filter never sees the other sensor."""
    evidence = filter_.encode(batch)
    belief = filter_.start(first_belief(filter_, batch), 0, torch.Generator())
    _, fused = filter_.step(belief, evidence[0], torch.Generator())
    _, alone = filter_.step(belief, standalone_evidence(filter_, batch, evidence, "haptics")[0], torch.Generator())
    assert fused.modality is not None
    torch.testing.assert_close(alone.estimate.mean, fused.modality.mean[:, 1], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(alone.estimate.covariance, fused.modality.covariance[:, 1], rtol=1e-3, atol=1e-5)


def test_information_adds(filter_: InformationFilter, batch: Batch) -> None:
    """The fused covariance is at most that of the prior, and shares sum to one."""
    evidence = filter_.encode(batch)
    belief = filter_.start(first_belief(filter_, batch), 0, torch.Generator())
    for t in range(STEPS):
        belief, trace = filter_.step(belief, evidence[t], torch.Generator())
        assert isinstance(trace.predicted, Gaussian)
        gain = trace.predicted.covariance[:, 0] - trace.estimate.covariance
        assert (torch.linalg.eigvalsh(gain) > -1e-5).all()
    torch.testing.assert_close(filter_.shares(evidence).sum(2), torch.ones(STEPS, N, 3))


def test_haptics_are_relative_to_the_hand(filter_: InformationFilter, batch: Batch) -> None:
    """A common shift of hand and object shifts the virtual observation, and leaves its noise unchanged."""
    moved = shift_positions(batch, filter_.task, torch.tensor([0.1, 0.1, 0.0]), torch.Generator().manual_seed(0))
    shift = (moved.states - batch.states) / filter_.statistics.mean_std("state")[1]
    assert shift.abs().max() > 0.5
    before, after = filter_.encode(batch), filter_.encode(moved)
    assert before.noise is not None
    assert after.noise is not None
    torch.testing.assert_close(after.observation[:, :, 1], before.observation[:, :, 1] + shift, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(after.noise[:, :, 1], before.noise[:, :, 1], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(after.observation[:, :, 0], before.observation[:, :, 0])


def test_history_has_the_past_steps_and_nothing_else(filter_: InformationFilter, batch: Batch) -> None:
    values = torch.arange(8.0).reshape(8, 1, 1)
    window = recent_steps(values, 2, [])
    assert window[5, 0].tolist() == [5, 4, 3]
    assert window[0, 0].tolist() == [0, 0, 0]
    assert recent_steps(values, 2, [0])[5, 0].tolist() == [0, -1, -2]
    whole = filter_.encode(batch).observation
    later = Batch(
        {name: values[-1 - HISTORY :] for name, values in batch.observations.items()},
        *(values[-1 - HISTORY :] for values in (batch.controls, batch.states, batch.contact)),
        batch.previous,
    )
    torch.testing.assert_close(filter_.encode(later).observation[-1], whole[-1])
    changed = {**later.observations, "haptics": later.observations["haptics"].clone()}
    changed["haptics"][0] += 1.0
    assert (filter_.encode(replace(later, observations=changed)).observation[-1] != whole[-1]).any()


def test_static_components_do_not_move(filter_: InformationFilter, batch: Batch) -> None:
    states, control = torch.randn(5, 3), filter_.dynamics.control_part(torch.randn(5, 6))
    moved, jacobian = filter_.dynamics.with_jacobian(states, control)
    torch.testing.assert_close(moved, filter_.dynamics(states, control))
    assert torch.equal(moved[:, :2], states[:, :2])
    assert (moved[:, 2] != states[:, 2]).all()
    torch.testing.assert_close(jacobian[:, :2], torch.eye(3)[:2].expand(5, -1, -1))


def test_sensors_are_trained_by_their_likelihood_and_then_frozen(episodes: list[Episode]) -> None:
    filter_ = build(architecture("door-field", "information-ekf"), seed=0)
    assert isinstance(filter_, InformationFilter)
    steps = Steps.from_episodes(filter_.task, episodes)
    filter_.statistics.fit(steps)
    trainer = Trainer(filter_, steps, replace(PLANS["smoke"], models=20), 0, blackouts=(0.0,))
    every = steps.windows(steps.first, STEPS)
    names = [stage.name for stage in trainer.stages()]
    models = [name for name in names if name.endswith(" model")]
    assert models == ["image model", "haptics model"]
    for stage in trainer.stages():
        before = {name: p.detach().clone() for name, p in filter_.named_parameters()}
        loss = {name: float(sensor_likelihood(filter_, name, every).detach()) for name in filter_.names}
        stage.run()
        changed = {name.split(".")[0] for name, p in filter_.named_parameters() if not torch.equal(p, before[name])}
        if stage.name in models:
            name = stage.name.removesuffix(" model")
            assert float(sensor_likelihood(filter_, name, every).detach()) < loss[name]
        elif names.index(stage.name) > names.index(models[-1]):
            assert changed <= {"dynamics", "weight_model", "log_scale"}
            assert "log_scale" in changed
    assert names[-1].startswith("end to end")


def test_other_kinds_have_no_information_form() -> None:
    with pytest.raises(BadInput, match="fusion 'information' needs kind 'ekf'"):
        replace(architecture("door", "information-ekf"), kind="pf")


def test_evidence_without_a_model_has_no_share(filter_: InformationFilter, batch: Batch) -> None:
    evidence: Evidence = filter_.encode(batch).only(1)
    torch.testing.assert_close(filter_.shares(evidence)[:, :, 1], torch.ones(STEPS, N, 3))

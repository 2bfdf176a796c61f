"""The information filter: a Kalman filter of state and biases, invariant to translation, calibrated stage by stage."""

from __future__ import annotations

import math
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
from beliefscope.filters.models.fusion import powers, product_of_experts, weighted_product
from beliefscope.filters.models.information import MAX_NOISE, InformationFilter, recent_steps
from beliefscope.filters.models.path_circle import circle
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.filters.subsets import standalone_evidence
from beliefscope.filters.training.losses import NOISE_FACTORS, sensor_likelihood
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


def kalman_update(prior: Gaussian, z: Tensor, h: Tensor, r: Tensor) -> Gaussian:
    """Textbook update with z (m,) of ``h`` (m, s) and noise covariance r (m, m)."""
    gain = prior.covariance @ h.T @ torch.linalg.inv(h @ prior.covariance @ h.T + r)
    mean = prior.mean + gain @ (z - h @ prior.mean)
    return Gaussian(mean, (torch.eye(len(mean), dtype=torch.float64) - gain @ h) @ prior.covariance)


def equal_weights(filter_: InformationFilter, batch: Batch) -> Evidence:
    """Evidence with beta 1/2 in which one reading is too uncertain to be used."""
    evidence = filter_.encode(batch)
    assert evidence.log_weights is not None
    assert evidence.noise is not None
    noise = 0.1 + 0.8 * torch.rand(evidence.noise.shape, generator=torch.Generator().manual_seed(0))
    noise[4, :, 0, 2] = 1.5 * MAX_NOISE
    log_weights = torch.full_like(evidence.log_weights, -math.log(2.0))
    return replace(evidence, noise=noise.double(), log_weights=log_weights)


def double_filter(bias: float) -> InformationFilter:
    filter_ = build(architecture("door-field", "information-ekf"), seed=3).double().eval().requires_grad_(False)
    assert isinstance(filter_, InformationFilter)
    filter_.log_bias.copy_(torch.tensor(bias).log() + 0.1 * torch.arange(6.0).reshape(2, 3))
    filter_.memory.copy_(torch.arange(6.0).reshape(2, 3))
    nn.init.normal_(filter_.dynamics.output.weight, std=0.5, generator=torch.Generator().manual_seed(4))
    filter_.log_motion.copy_(torch.arange(3.0))
    filter_.log_scale.copy_(-0.1 * torch.arange(6.0).reshape(2, 3))
    return filter_


def test_equal_weights_give_the_kalman_filter_of_state_and_biases(batch: Batch) -> None:
    filter_ = double_filter(bias=0.5)
    evidence, start = equal_weights(filter_, batch), first_belief(filter_, batch)
    estimate = rollout(filter_, evidence, start, torch.Generator()).estimate
    eye = torch.eye(3, dtype=torch.float64)
    phi, variance = filter_.phi.flatten(), filter_.bias.flatten() ** 2
    for i in range(N):
        belief = Gaussian(
            torch.cat([start.mean[i], torch.zeros(6, dtype=torch.float64)]),
            torch.block_diag(start.covariance[i], torch.diag(variance)),
        )
        for t in range(STEPS):
            mean, jacobian = filter_.dynamics.with_jacobian(belief.mean[:3], evidence.control[t, i])
            transition = torch.block_diag(jacobian, torch.diag(phi))
            motion = filter_.log_motion.exp() ** 2 * (mean - belief.mean[:3]).square().sum()
            moved = filter_.dynamics.noise**2 + motion * torch.tensor([0.0, 0.0, 1.0])
            noise = torch.cat([moved, variance * (1 - phi**2)])
            covariance = transition @ belief.covariance @ transition.T + torch.diag(noise)
            belief = Gaussian(torch.cat([mean, phi * belief.mean[3:]]), covariance)
            assert evidence.noise is not None
            image, haptics = torch.diag_embed(evidence.noise[t, i])
            h = torch.cat([torch.cat([eye, image, 0 * eye], dim=1), torch.cat([eye, 0 * eye, haptics], dim=1)])
            used = (evidence.noise[t, i] < MAX_NOISE).flatten()
            assert used.sum() == (5 if t == 4 else 6)
            r = torch.diag(((evidence.noise[t, i] * filter_.log_scale.exp()) ** 2).flatten()[used])
            belief = kalman_update(belief, evidence.observation[t, i].flatten()[used], h[used], r)
            torch.testing.assert_close(estimate.mean[t, i], belief.mean[:3])
            torch.testing.assert_close(estimate.covariance[t, i], belief.covariance[:3, :3])


def test_without_biases_precisions_add(batch: Batch) -> None:
    """``P^-1 = P'^-1 + sum p_k R_k^-1``, ``m = m' + P sum p_k R_k^-1 (z_k - m')``."""
    filter_ = double_filter(bias=0.0)
    evidence = equal_weights(filter_, batch)
    beta = torch.rand(STEPS, N, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    evidence = replace(evidence, log_weights=torch.log_softmax(beta, dim=2))
    belief = filter_.start(first_belief(filter_, batch), 0, torch.Generator())
    for t in range(STEPS):
        belief, trace = filter_.step(belief, evidence[t], torch.Generator())
        assert isinstance(trace.predicted, Gaussian)
        assert evidence.noise is not None
        assert evidence.log_weights is not None
        power = 2.0 * evidence.log_weights[t].exp() * (evidence.noise[t] < MAX_NOISE)
        precision = power / (evidence.noise[t] * filter_.log_scale.exp()) ** 2
        prior = Gaussian(trace.predicted.mean[:, 0], trace.predicted.covariance[:, 0])
        covariance = torch.linalg.inv(torch.linalg.inv(prior.covariance) + torch.diag_embed(precision.sum(1)))
        information = (precision * (evidence.observation[t] - prior.mean.unsqueeze(1))).sum(1)
        torch.testing.assert_close(trace.estimate.covariance, covariance)
        torch.testing.assert_close(trace.estimate.mean, prior.mean + (covariance @ information.unsqueeze(-1))[..., 0])


def test_a_lasting_bias_is_learned_from_the_other_sensor(batch: Batch) -> None:
    """With a constant image error, the image alone is more accurate after some steps with haptics."""
    filter_ = double_filter(bias=0.5)
    filter_.memory.fill_(9.0)
    filter_.dynamics.log_noise.fill_(0.0)
    evidence, start = equal_weights(filter_, batch), first_belief(filter_, batch)
    truth = start.mean.expand(STEPS, -1, -1)
    bias = torch.tensor([[0.4, -0.3, 0.2], [0.0, 0.0, 0.0]], dtype=torch.float64)
    evidence = replace(
        evidence, observation=truth.unsqueeze(2) + bias, noise=torch.full_like(bias, 0.3).expand(STEPS, N, 2, 3)
    )
    evidence = replace(evidence, control=torch.zeros_like(evidence.control))
    filter_.log_bias[1] = -20.0
    both = torch.ones(STEPS, N, 2, dtype=torch.bool)
    both[STEPS // 2 :, :, 1] = False
    image = both.clone()
    image[..., 1] = False
    errors = [
        (
            rollout(filter_, evidence.select_models(present), start, torch.Generator()).estimate.mean[-1] - truth[-1]
        ).norm()
        for present in (both, image)
    ]
    assert errors[0] < 0.6 * errors[1]


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
    torch.testing.assert_close(trace.estimate.mean, trace.predicted.mean[:, 0])
    torch.testing.assert_close(trace.estimate.covariance, trace.predicted.covariance[:, 0])
    torch.testing.assert_close(posterior.covariance[:, 3:, 3:], belief.covariance[:, 3:, 3:])  # stationary biases


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


def test_haptics_are_relative_to_the_hand() -> None:
    """A common shift of hand and object shifts the virtual observation, and leaves its noise unchanged."""
    task = find_task("push-field")
    assert task.simulate is not None
    filter_ = build(architecture("push-field", "information-ekf"), seed=0).eval().requires_grad_(False)
    steps = Steps.from_episodes(task, [task.simulate(2, index, STEPS) for index in range(N)])
    filter_.statistics.fit(steps)
    batch = steps.windows(steps.first, STEPS)
    moved = shift_positions(batch, filter_.task, torch.tensor([0.1, 0.1]), torch.Generator().manual_seed(0))
    shift = (moved.states - batch.states) / filter_.statistics.mean_std("state")[1]
    assert shift.abs().max() > 0.5
    before, after = filter_.encode(batch), filter_.encode(moved)
    assert before.noise is not None
    assert after.noise is not None
    torch.testing.assert_close(after.observation[:, :, 1], before.observation[:, :, 1] + shift, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(after.noise[:, :, 1], before.noise[:, :, 1], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(after.observation[:, :, 0], before.observation[:, :, 0])


@pytest.mark.slow
def test_history_has_the_past_steps_and_nothing_else(filter_: InformationFilter) -> None:
    values = torch.arange(8.0).reshape(8, 1, 1)
    window = recent_steps(values, (1, 2), [])
    assert window[5, 0].tolist() == [5, 4, 3]
    assert window[0, 0].tolist() == [0, 0, 0]
    assert recent_steps(values, (1, 2), [0])[5, 0].tolist() == [0, -1, -2]
    assert filter_.task.simulate is not None
    steps = Steps.from_episodes(filter_.task, [filter_.task.simulate(2, 0, filter_.history + 4)])
    whole = filter_.encode(steps.episode(0)).observation
    later = steps.windows(steps.first + 3, filter_.history + 1)
    torch.testing.assert_close(filter_.encode(later).observation[-1], whole[-1])
    torch.testing.assert_close(filter_.encode_after(later, filter_.history).observation, whole[-1:])
    earlier = {**later.observations, "image": later.observations["image"].clone()}
    earlier["image"][:-1] = 0
    after = filter_.encode_after(replace(later, observations=earlier), filter_.history)
    torch.testing.assert_close(after.observation, whole[-1:])

    changed = {**later.observations, "haptics": later.observations["haptics"].clone()}
    changed["haptics"][0] += 1.0
    assert (filter_.encode(replace(later, observations=changed)).observation[-1] != whole[-1]).any()


def test_circle_through_a_path() -> None:
    """The fit finds the centre of an arc, starts from the prior, and ignores steps without contact."""
    angle = torch.linspace(0.0, 1.5, 60)
    centre, prior = torch.tensor([0.5, -0.2]), torch.tensor([0.4, -0.1])
    arc = (centre + 0.45 * torch.stack([angle.cos(), angle.sin()], dim=-1)).unsqueeze(1)
    contact = torch.ones(60, 1, dtype=torch.bool)
    fitted, shape = circle(arc, contact, prior)
    assert (fitted[-1, 0] - centre).norm() < 0.01
    assert (fitted[0, 0] - prior).norm() < 1e-6
    assert (shape[1:, 0, 3] > shape[:-1, 0, 3]).all()  # a longer path is more informative
    outlier, free = arc.clone(), contact.clone()
    outlier[20] += 1.0
    free[20] = False
    away, _ = circle(outlier, free, prior)
    assert (away[-1, 0] - centre).norm() < 0.01
    assert torch.equal(away[:20], fitted[:20])


def test_static_components_do_not_move(filter_: InformationFilter, batch: Batch) -> None:
    states, control = torch.randn(5, 3), filter_.dynamics.control_part(torch.randn(5, 6))
    moved, jacobian = filter_.dynamics.with_jacobian(states, control)
    torch.testing.assert_close(moved, filter_.dynamics(states, control))
    assert torch.equal(moved[:, :2], states[:, :2])
    assert (moved[:, 2] != states[:, 2]).all()
    torch.testing.assert_close(jacobian[:, :2], torch.eye(3)[:2].expand(5, -1, -1))


class ConstantNoise:
    """A sensor with given readings and the same reported noise at all steps."""

    def __init__(self, filter_: InformationFilter, readings: Tensor, noise: float) -> None:
        self.statistics, self.observations = filter_.statistics, filter_.observations
        self.n, self.angles = filter_.n, filter_.angles
        self.reading = readings, torch.full_like(readings, noise)

    def sense(self, name: str, observations: object) -> tuple[Tensor, Tensor]:
        return self.reading

    def has_reading(self, batch: Batch, modalities: list[str]) -> Tensor:
        return torch.ones(batch.states.shape[:2], dtype=torch.bool)


def sensor_loss(
    filter_: InformationFilter, batch: Batch, error: float, noise: float, factors: tuple[float, ...] = (1.0,)
) -> float:
    """Loss of a sensor with this standard deviation of the error, infinite for readings of 0, and reported noise."""
    generator = torch.Generator().manual_seed(0)
    truth, white = torch.randn(2, 4096, 1, 3, generator=generator)
    readings = truth + error * white if error < torch.inf else torch.zeros_like(truth)
    sensor = ConstantNoise(filter_, readings, noise)
    many = replace(batch, states=filter_.statistics.state_to_si(truth))
    return float(sensor_likelihood(sensor, "image", many, factors))  # type: ignore[arg-type]


def test_a_sensor_without_information_has_an_optimum_at_infinite_noise(
    batch: Batch, filter_: InformationFilter
) -> None:
    """The prior of the training states is not part of a sensor, so that a filter may use it at every step."""
    losses = [sensor_loss(filter_, batch, torch.inf, noise) for noise in (1.0, 10.0, 100.0)]
    assert losses[0] > losses[1] > losses[2]


def test_validation_prefers_an_overconfident_sensor_to_an_untrained_one(
    batch: Batch, filter_: InformationFilter
) -> None:
    """Calibration corrects a constant factor on the noise."""
    untrained, overconfident = (torch.inf, 1.0), (0.3, 0.3 / NOISE_FACTORS[6])
    assert sensor_loss(filter_, batch, *overconfident) > sensor_loss(filter_, batch, *untrained)
    validated = [sensor_loss(filter_, batch, *sensor, NOISE_FACTORS) for sensor in (overconfident, untrained)]
    assert validated[0] < validated[1] - 1.0
    # Rounding of float32 only.
    assert validated[0] == pytest.approx(sensor_loss(filter_, batch, 0.3, 0.3), abs=1e-4)


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
            errors = {"dynamics", "log_scale", "log_bias", "memory", "log_motion"}
            assert changed == errors | ({"weight_model"} if stage.name == names[-2] else set())
            trained = [n for n, p in filter_.dynamics.named_parameters() if not torch.equal(p, before[f"dynamics.{n}"])]
            assert trained == ["log_noise"]
    assert names[-2:] == ["weights and errors", "calibration"]


def test_other_kinds_have_no_information_form() -> None:
    with pytest.raises(BadInput, match="fusion 'information' needs kind ekf or pf"):
        replace(architecture("door", "information-ekf"), kind="ukf")


def test_evidence_without_a_model_has_no_share(filter_: InformationFilter, batch: Batch) -> None:
    evidence: Evidence = filter_.encode(batch).only(1)
    torch.testing.assert_close(filter_.shares(evidence)[:, :, 1], torch.ones(STEPS, N, 3))

"""A particle filter from outside: causes that its reported particles and weights show."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.covariate import CONTACT
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.diagnosis.catalog import CAUSES, causes_of
from beliefscope.inspect.diagnosis.cause import Diagnosis
from beliefscope.inspect.diagnosis.checks.equations import relative_spread, reported_particle_statistics
from beliefscope.inspect.diagnosis.checks.modules import model_statistics
from beliefscope.inspect.diagnosis.checks.true_starts import with_particles_near_truth
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.healthy import profile_of

TASK = bs.Task(
    "rail",
    (bs.Component("x", "m"),),
    {"near": (1,), "far": (1,)},
    {"near": ("near",), "far": ("far",)},
    1,
    0.1,
    warmup=0,
)
STD = {"near": 0.1, "far": 0.15}


def ride(seed: int, steps: int = 40) -> bs.Episode:
    rng = np.random.default_rng(seed)
    speed = rng.normal(0, 0.3, (steps, 1))
    x = np.cumsum(0.1 * speed + rng.normal(0, 0.05, (steps, 1)), axis=0)
    return bs.Episode(TASK, x, controls=speed, observations={k: x + rng.normal(0, s, x.shape) for k, s in STD.items()})


class Particles:
    def __init__(
        self,
        count: int = 100,
        powers: Mapping[str, float] | None = None,
        resample: bool = True,
        best_only: bool = False,
        weighted: bool = True,
        variance: float = 1.0,
        keeps_weights: bool = True,
        offset: float = 0.0,
        width: float = 1.0,
    ) -> None:
        self.keeps_weights, self.offset, self.width = keeps_weights, offset, width
        self.count, self.powers, self.resample, self.best_only = count, powers or {}, resample, best_only
        self.weighted, self.variance = weighted, variance

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.rng = np.random.default_rng(0)
        self.x = mean + np.sqrt(covariance[0]) * self.rng.standard_normal((self.count, 1))
        self.log_weights = np.full(self.count, -np.log(self.count))

    def __call__(self, *, observations: Any, controls: Any) -> dict[str, Any]:
        self.x = self.x + 0.1 * controls + 0.05 * self.rng.standard_normal((self.count, 1))
        prior = self.log_weights if self.keeps_weights else np.full(self.count, -np.log(self.count))
        offsets = {"near": self.offset, "far": 0.0}
        errors = {k: observations[k] - self.x[:, 0] - offsets[k] for k in STD}
        widths = {"near": self.width, "far": 1.0}
        likelihood = np.stack([-0.5 * (errors[k] / s / widths[k]) ** 2 for k, s in STD.items()])
        posterior = prior + sum(self.powers.get(k, 1.0) * row for k, row in zip(STD, likelihood, strict=True))
        posterior -= np.logaddexp.reduce(posterior)
        values = {"particles": self.x, "log_weights": posterior, "prior_log_weights": prior}
        mean = np.exp(posterior) @ self.x
        covariance = self.variance * np.exp(posterior)[None] @ np.square(self.x - mean)
        values |= {"log_likelihood": likelihood, "estimate_mean": mean if self.weighted else self.x.mean(0)}
        values |= {"estimate_covariance": covariance}
        self.log_weights = posterior
        ancestors = np.arange(self.count)
        if self.resample and 1 / np.exp(2 * posterior).sum() < 0.5 * self.count:
            weights = np.eye(self.count)[posterior.argmax()] if self.best_only else np.exp(posterior)
            ancestors = self.rng.choice(self.count, self.count, p=weights)
            self.x = self.x[ancestors]
            self.log_weights = np.full(self.count, -np.log(self.count))
        return values | {"ancestors": ancestors}


def filter_of(module: Particles) -> Any:
    return as_external(bs.Adapter(module, batched=False, modalities=tuple(STD), initial_std=(0.1,)), "rail", TASK)


@cache
def record() -> HealthyProfile:
    return profile_of(filter_of(Particles()), [ride(seed) for seed in range(14)], "test")


def diagnosis(module: Particles) -> Diagnosis:
    return diagnose(filter_of(module), {seed: ride(seed) for seed in range(100, 106)}, profile=record())


@pytest.mark.parametrize("spread", [0.1, 1.0, 3.0])
def test_spread_of_offspring_does_not_depend_on_the_weights(spread: float) -> None:
    """Of systematic and of independent resampling, but of one by the squares of the weights."""
    rng, steps, count = np.random.default_rng(0), 200, 300
    weights = np.exp(spread * rng.standard_normal((steps, count)))
    weights /= weights.sum(1, keepdims=True)

    def drawn(w: Any, pointers: Any) -> Any:
        edges = np.cumsum(w, 1)
        edges[:, -1] = 1.0
        chosen = [np.searchsorted(edge, pointer) for edge, pointer in zip(edges, pointers, strict=True)]
        return np.array([np.bincount(row, minlength=count) for row in chosen])

    even, independent = (np.arange(count) + rng.random((steps, 1))) / count, rng.random((steps, count))
    for pointers in (even, independent):
        assert relative_spread(drawn(weights, pointers), count * weights) == pytest.approx(1.0, abs=0.1)
    squares = weights**2 / (weights**2).sum(1, keepdims=True)
    assert relative_spread(drawn(squares, even), count * weights) > (1.02 if spread < 1.0 else 2.0)


def test_statistics_of_particles_that_a_filter_reports() -> None:
    healthy, half, off = (
        reported_particle_statistics(bs.trace(filter_of(module), [ride(0)], 0))
        for module in (Particles(), Particles(powers={"far": 0.5}), Particles(resample=False))
    )
    assert healthy["particles//all"] == 100.0
    assert healthy["prior ess//all"] == pytest.approx(1.0)
    assert off["prior ess//all"] < 0.3
    assert healthy["offspring//all"] == pytest.approx(1.0, abs=0.15)
    # of independent draws: 1 - 1 / e of the particles with equal weights
    assert 0.6 < healthy["relative ancestors//all"] < 1.0
    assert "offspring//all" not in off
    shares = [{k: values[f"likelihood share/{k}/all"] for k in STD} for values in (healthy, half, off)]
    assert shares[0] == pytest.approx({"near": 1.0, "far": 1.0}, abs=1e-3)
    assert shares[1] == pytest.approx({"near": 1.0, "far": 0.5}, abs=1e-3)
    assert shares[2] == pytest.approx({"near": 1.0, "far": 1.0}, abs=1e-3)


def test_an_ensemble_without_weights_has_its_number_of_members() -> None:
    run = bs.trace(filter_of(Particles(50)), [ride(3)])
    ensemble = replace(run, log_weights=None, prior_log_weights=None, log_likelihood=None, ancestors=None)
    assert reported_particle_statistics(ensemble) == {"particles//all": 50.0}


def test_estimates_are_compared_with_the_moments_of_the_particles() -> None:
    healthy, mean, quarter = (
        reported_particle_statistics(bs.trace(filter_of(module), [ride(0)], 0))
        for module in (Particles(), Particles(weighted=False), Particles(variance=0.25))
    )
    assert healthy["estimate mean//all"] == pytest.approx(0.0, abs=1e-4)  # the trace has single precision
    assert healthy["reported variance//all"] == pytest.approx(0.0, abs=1e-4)
    assert mean["estimate mean//all"] > 0.3
    assert quarter["reported variance//all"] == pytest.approx(np.log(0.25), abs=1e-4)


def test_weights_are_kept_without_resampling() -> None:
    for keeps, share in ((True, 0.0), (False, 1.0)):
        values = reported_particle_statistics(bs.trace(filter_of(Particles(keeps_weights=keeps)), [ride(0)], 0))
        assert values["lost weights//all"] == share


@pytest.mark.first(1)
@pytest.mark.parametrize("offset", [0.0, 0.1, -0.2])
def test_a_likelihood_with_an_offset_moves_the_particles_around_true_states(offset: float) -> None:
    """As a Kalman update of their mean does; without a model of the readings."""
    filter_ = filter_of(Particles(offset=offset))
    values = [model_statistics(bs.trace(filter_, [ride(seed)], 0), filter_) for seed in range(5)]
    near, far = (np.mean([v[f"likelihood offset/{key} x/all"] for v in values]) for key in STD)
    variance = with_particles_near_truth(bs.trace(filter_, [ride(0)], 0), filter_).particles.var(1)
    std = np.sqrt(np.nanmean(variance))
    # Five runs of 40 steps with noise of the readings: 0.1 is four standard deviations of their mean.
    assert near == pytest.approx(-offset * std / (std**2 + STD["near"] ** 2), abs=0.1)
    assert far == pytest.approx(0.0, abs=0.1)


def test_the_width_of_a_likelihood_is_proportional_to_its_standard_deviation() -> None:
    """Whatever the spread of the particles at the true states; without a model of the readings."""
    size = float(ride(0).states.std())
    for width in (1.0, 3.0):
        filter_ = filter_of(Particles(width=width))
        values = model_statistics(bs.trace(filter_, [ride(0)], 0), filter_)
        near, far = (values[f"likelihood width/{key}/all"] for key in STD)
        assert near == pytest.approx(width * STD["near"] / size, rel=1e-3)  # the trace has single precision
        assert far == pytest.approx(STD["far"] / size, rel=1e-3)


def test_the_width_of_a_displaced_likelihood_is_unknown() -> None:
    """Its curvature at the true state is not that at its maximum."""
    filter_ = filter_of(Particles(offset=1.0))
    values = model_statistics(bs.trace(filter_, [ride(0)], 0), filter_)
    assert abs(values["likelihood offset/near x/all"]) > 0.5
    assert {name for name in values if name.startswith("likelihood width/")} == {"likelihood width/far/all"}


def test_moments_of_angles_are_those_of_their_differences() -> None:
    """Particles on both sides of half a turn: the estimate at the turn is right, their arithmetic mean, 0, is wrong."""
    task = replace(TASK, components=(bs.Component("x", "rad", wraps=True),))
    trace = bs.trace(filter_of(Particles()), [ride(0)], 0)
    x = np.pi + np.linspace(-0.1, 0.1, 100)[:, None] * np.ones((len(trace), 1, 1))
    wrapped = ((x + np.pi) % (2.0 * np.pi) - np.pi).astype(np.float32)
    even = np.full_like(trace.log_weights, -np.log(100))
    turned = replace(trace, episode=replace(trace.episode, task=task), particles=wrapped, log_weights=even)
    for estimate, distance in ((np.pi, 0.0), (0.0, np.pi / x.std(1).mean())):
        mean = np.full_like(trace.estimate_mean, estimate)
        values = reported_particle_statistics(replace(turned, estimate_mean=mean))
        assert values["estimate mean//all"] == pytest.approx(distance, rel=0.01, abs=1e-3)


def test_likelihoods_of_steps_without_a_reading_are_updates() -> None:
    """The filter uses the held reading of a masked sensor; a flat likelihood is none."""
    task = replace(TASK, masks={"far": "seen"}, covariates={"seen": CONTACT})
    seen = (np.arange(40) % 2).astype(np.float32)
    trace = bs.trace(filter_of(Particles()), [ride(0)], 0)
    masked = replace(trace, episode=replace(trace.episode, task=task, covariates={"seen": seen}))
    assert reported_particle_statistics(masked)["absent updates/far/all"] == 1.0
    assert "absent updates/near/all" not in reported_particle_statistics(masked), "it always has a reading"
    flat = masked.log_likelihood.copy()
    flat[:, 1] *= seen[:, None]
    assert reported_particle_statistics(replace(masked, log_likelihood=flat))["absent updates/far/all"] == 0.0


@pytest.mark.first(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "cause"),
    [
        (Particles(count=8), "particles.few"),
        (Particles(powers={"far": 0.0}), "weights.ignores_likelihood"),
        pytest.param(Particles(powers={"far": 2.0}), "weights.repeats_likelihood", marks=pytest.mark.long),
        (Particles(resample=False), "resampling.off"),
        pytest.param(Particles(best_only=True), "particles.deprived", marks=pytest.mark.long),
        (Particles(weighted=False), "estimate.mean"),
        pytest.param(Particles(keeps_weights=False), "weights.lost", marks=pytest.mark.long),
        pytest.param(Particles(offset=0.1), "measurement.near.function", marks=pytest.mark.long),
        pytest.param(Particles(powers=dict.fromkeys(STD, -1.0)), "weights.ignores_likelihood", marks=pytest.mark.long),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_faults_of_the_particles_of_an_external_filter_are_named(module: Particles, cause: str) -> None:
    result = diagnosis(module)
    assert (result.state, result.causes[0].cause.name) == ("fault", cause)
    assert "--particles" not in result.causes[0].next  # the number of an external filter is its own


def stuck(readings: np.ndarray) -> np.ndarray:
    return np.where(np.arange(len(readings))[:, None] < 10, readings, readings[10])


def noisy(readings: np.ndarray) -> np.ndarray:
    return readings + np.random.default_rng(0).normal(0, 0.5, readings.shape)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "cause", "headline"),
    [
        (stuck, "near.stuck", "Sensor near stuck from step 11 (1.1 s),"),
        pytest.param(noisy, "near.noise", "Sensor near noisy", marks=pytest.mark.long),
    ],
)
def test_a_sensor_of_a_users_task_has_causes(
    change: Callable[[np.ndarray], np.ndarray], cause: str, headline: str
) -> None:
    episodes = {seed: ride(seed) for seed in range(100, 106)}
    for episode in episodes.values():
        episode.observations["near"][:] = change(episode.observations["near"])
    result = diagnose(filter_of(Particles()), episodes, profile=record())
    assert (result.state, result.causes[0].cause.name) == ("fault", cause)
    assert result.headline.startswith(headline)


def test_built_in_tasks_have_the_causes_of_the_catalog() -> None:
    for name in ("door", "push-field", "door-field"):
        assert causes_of(load_task(name)) == CAUSES
    own = {cause.name for cause in causes_of(TASK)} - {cause.name for cause in CAUSES}
    mechanisms = ("stuck", "noise", "saturation", "bias", "drift", "gain", "delay", "sign")
    models = [f"model.{k}.{m}" for k in STD for m in ("bias", "overconfident", "underconfident", "broken")]
    sensors = [f"{key}.{mechanism}" for key in STD for mechanism in mechanisms]
    assert own == {
        *sensors,
        *models,
        "weights.ignores_near",
        "weights.ignores_far",
        "control.sign",
        "control.axes",
        "control.bias",
        "dynamics.inverted",
    }

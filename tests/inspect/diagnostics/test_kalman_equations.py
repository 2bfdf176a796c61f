"""Jacobians and updates of external Kalman filters, by single steps of them from other beliefs."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.inspect.diagnosis.checks.test_innovations import FLIPPED, STD, Array, Boat, loaded, run, sail, task, wrapped

import beliefscope as bs
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.catalog import DIAGNOSTICS, run_diagnostics
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnostics.kalman_equations import KalmanEquations, check_equations, jacobian_statistics
from beliefscope.inspect.healthy import profile_of

COMPONENTS = [component.name for component in task(1).components]


def errors_of(filter_: Boat, every: int = 4) -> tuple[Array, Array, Array]:
    """Of the columns of F, by component; of H, and slopes of the corrections, by modality."""
    values = jacobian_statistics(run(filter_, every), loaded(filter_, every))
    names = {"prediction": COMPONENTS, "measurement": STD}
    f, h = (np.array([values[f"{kind} jacobian/{name}/all"] for name in each]) for kind, each in names.items())
    return f, h, np.array([values[f"correction slope/{name}/all"] for name in STD])


@pytest.mark.first(4)
@pytest.mark.parametrize("every", [1, 4])
@pytest.mark.parametrize("filter_", [Boat(), Boat(separate=True), Boat(radar=5.0), Boat(offset=0.5), Boat(turn=0.6)])
def test_exact_derivatives_have_no_error_whatever_the_other_defects(filter_: Boat, every: int) -> None:
    f, h, slopes = errors_of(filter_, every)
    exact = f[:3] if filter_.turn != 1.0 else f  # the derivative by the bias is that of the right turn
    np.testing.assert_allclose(exact, 0.0, atol=1e-3)  # of differences of single-precision covariances
    np.testing.assert_allclose(h, 0.0, atol=0.02)  # the gains of the update before change with the variance
    assert slopes.min() > 0.98


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_error_of_a_scaled_jacobian_is_that_of_its_square(factor: float) -> None:
    """``f^2 H E H^T`` against ``H E H^T``."""
    _, (radar, compass), _ = errors_of(Boat(jacobian=factor))
    assert radar == pytest.approx(abs(factor**2 - 1.0), rel=0.02)
    assert compass == pytest.approx(0.0, abs=0.05)


def test_corrections_with_the_wrong_sign_have_a_slope_of_minus_one() -> None:
    _, (radar, _), (slope, _) = errors_of(Boat(jacobian=-1.0))
    assert radar == pytest.approx(0.0, abs=0.01)
    assert slope == pytest.approx(-1.0, abs=0.05)


@pytest.mark.parametrize("filter_", [Boat(), Boat(radar=5.0), Boat(gain=0.5), Boat(reduction=0.0), Boat(reduction=0.8)])
def test_the_reduction_of_the_covariance_is_relative_to_that_of_a_right_update(filter_: Boat) -> None:
    """Whatever R and the gain of the mean."""
    slope = jacobian_statistics(run(filter_, 4), loaded(filter_, 4))["covariance update//all"]
    assert slope == pytest.approx(filter_.reduction, abs=0.01)


def test_corrections_with_a_covariance_that_is_not_updated_have_a_slope_of_one() -> None:
    """All gains are those of the predicted covariance; both sensors have a reading at every step."""
    filter_ = Boat(reduction=0.0)
    values = jacobian_statistics(run(filter_, 1), loaded(filter_, 1))
    for key in STD:
        assert values[f"correction slope/{key}/all"] == pytest.approx(1.0, abs=0.05)


def test_a_wrong_sign_in_one_column_shows_in_its_modality() -> None:
    f, (radar, compass), _ = errors_of(Boat(jacobian=FLIPPED))
    assert radar > 0.5 > 3.0 * compass
    np.testing.assert_allclose(f, 0.0, atol=1e-3)


def test_a_wrong_column_of_the_dynamics_shows_in_its_component() -> None:
    """Without its derivative, the heading has ``F_i = e_i`` instead of ``(a, b, 1)``."""
    f, h, _ = errors_of(Boat(heading_jacobian=0.0))
    assert f[2] > 0.05
    np.testing.assert_allclose(np.delete(f, 2), 0.0, atol=1e-3)
    np.testing.assert_allclose(h, 0.0, atol=0.02)


class Widening(Boat):
    """Starts at another belief than it is given."""

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        super().initialize_beliefs(mean=mean, covariance=covariance + 0.1 * np.eye(4))


def test_filters_with_another_start_or_without_covariances_have_no_statistics() -> None:
    trace, filter_ = run(Boat()), loaded(Boat())
    assert jacobian_statistics(run(Widening()), loaded(Widening())) == {}
    assert jacobian_statistics(replace(trace, predicted_covariance=None), filter_) == {}
    without = jacobian_statistics(replace(trace, innovation=None, innovation_covariance=None), filter_)
    assert sorted(without) == sorted(f"prediction jacobian/{name}/all" for name in COMPONENTS)


def test_trajectories_with_different_sensors_are_run_together() -> None:
    """A filter without the axis N reports one channel at steps without the radar, and two at others."""
    values, _ = loaded(Boat()).run([sail(3).part(1, 2), sail(3).part(0, 1)])
    assert values["innovation"].shape == (1, 2, 2, 2)


class Exact(Boat):
    """Knows the bias: its variance is 0."""

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        super().initialize_beliefs(mean=mean, covariance=covariance)
        self.covariance = covariance * np.array([1.0, 1.0, 1.0, 0.0])

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        values = super().__call__(observations=observations, controls=controls)
        self.covariance = self.covariance * np.outer([1, 1, 1, 0], [1, 1, 1, 0])
        return values | {"estimate_covariance": self.covariance}


def test_known_components_have_no_error() -> None:
    values = jacobian_statistics(run(Exact()), loaded(Exact()))
    assert np.isfinite([v for name, v in values.items() if "bias" not in name]).all()


def equations(filter_: Boat, count: int = 2) -> KalmanEquations:
    checkpoint = loaded(filter_)
    return check_equations([bs.trace(checkpoint, [sail(seed)]) for seed in range(count)], checkpoint)


@pytest.mark.parametrize("filter_", [Boat(), Boat(separate=True), Boat(radar=5.0, offset=0.5)])
def test_right_jacobians_raise_no_alarm(filter_: Boat) -> None:
    result = equations(filter_)
    assert result.alarms == ()
    assert result.verdict.startswith(
        "Jacobians and updates agree with finite differences of the filter's own functions"
    )


def test_a_wrong_jacobian_is_named_with_its_part() -> None:
    scaled, flipped, constant = (
        equations(filter_) for filter_ in (Boat(jacobian=1.2), Boat(jacobian=FLIPPED), Boat(heading_jacobian=0.0))
    )
    assert scaled.alarms == ("the Jacobian of radar differs from finite differences by 44 %, for x, y",)
    assert len(flipped.alarms) == 1
    assert flipped.alarms[0].endswith(("%, for x", "%, by the sign of a column"))  # by how much it moves the range
    assert len(constant.alarms) == 1
    assert constant.alarms[0].startswith("the Jacobian of the dynamics differs")
    assert constant.alarms[0].endswith("in column heading")


def test_a_column_of_the_wrong_sign_shows_with_all_variances_together_only() -> None:
    result = equations(Boat(jacobian=np.array([-1.0, 1.0, 1.0, 1.0])))
    assert result.columns[:-1, 0] == pytest.approx(0.0, abs=0.05)
    assert result.columns[-1, 0] > 0.5
    assert result.alarms[0].endswith("%, by the sign of a column")


def test_corrections_of_the_wrong_sign_are_named() -> None:
    (alarm,) = equations(Boat(jacobian=-1.0)).alarms
    assert re.fullmatch(r"corrections with radar have the wrong sign \(slope -(1.00|0.9\d)\)", alarm)


class Inverted(Boat):
    """A random walk with the compass, whose first call does not predict. Its corrections have the wrong sign."""

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.mean, self.covariance, self.noise = mean, covariance, np.zeros((4, 4))

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        mean, covariance, h = self.mean, self.covariance + self.noise, self.H["compass"]
        self.noise = 1e-2 * np.eye(4)
        innovation, size = wrapped(observations["compass"] - mean[2]), h @ covariance @ h.T + STD["compass"][0] ** 2
        gain = covariance @ h.T / size
        self.mean, self.covariance = mean - gain @ innovation, covariance - gain @ h @ covariance
        return {
            "estimate_mean": self.mean,
            "estimate_covariance": self.covariance,
            "predicted_mean": np.stack([mean] * 2),
            "predicted_covariance": np.stack([covariance] * 2),
            "innovation": [None, innovation],
            "innovation_covariance": [None, size],
        }


def test_an_update_before_the_prediction_does_not_change_the_jacobian_of_the_dynamics() -> None:
    result = equations(Inverted())
    assert np.nanmax(result.dynamics) < 0.01
    np.testing.assert_allclose(result.process_noise, 0.1, rtol=0.01)
    (alarm,) = result.alarms
    assert alarm.startswith("corrections with compass have the wrong sign")


def test_a_filter_without_finite_differences_is_refused() -> None:
    entry = DIAGNOSTICS["equations"]
    trace = run(Widening())
    assert entry.refusal(trace, loaded(Widening())) is None
    with pytest.raises(BadInput, match="they depend on more than its belief and its inputs"):
        entry([trace], loaded(Widening()))
    assert entry.refusal(replace(trace, predicted_covariance=None), loaded(Widening())) is not None


def test_a_filter_without_finite_differences_has_other_diagnostics() -> None:
    results, reasons = run_diagnostics([run(Widening())], loaded(Widening()))
    assert "consistency" in results
    assert "they depend on more than its belief and its inputs" in reasons["equations"]


def test_without_a_filter_to_run_a_live_run_has_the_diagnostics_of_its_trace() -> None:
    trace = run(Boat())
    unavailable = UnavailableFilter(trace.filter, trace.checkpoint_hash, trace.task)
    results, reasons = run_diagnostics([trace], unavailable, slow=True)
    assert {"consistency", "innovations", "errors"} <= set(results)
    for name in ("maps", "standalone", "efficiency", "equations", "shapley", "saliency", "conventions"):
        assert "needs the filter, not only its trace" in reasons[name]


class Timed(Boat):
    """Moves for the duration of each step."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        return super().__call__(observations=observations, controls=controls * observations["dt"] / 0.1)


def test_repeated_steps_have_the_durations_of_irregular_steps() -> None:
    checkpoint, times = loaded(Timed()), np.cumsum(np.random.default_rng(0).uniform(0.05, 0.5, 100))
    trace = bs.trace(checkpoint, [replace(sail(0), time=times - times[0])])
    result = check_equations([trace], checkpoint)
    assert result.alarms == ()


@pytest.mark.long
def test_wrong_jacobians_are_mentioned_although_the_record_has_them_too() -> None:
    wrong = loaded(Boat(jacobian=FLIPPED))
    record = profile_of(wrong, [sail(seed) for seed in range(20)], "boat")
    result = diagnose(wrong, {seed: sail(seed) for seed in range(40, 44)}, profile=record)
    assert result.state == "healthy"
    assert result.provenance["miscalibrated"]
    assert result.headline.startswith("The Jacobian of radar differs from finite differences by ")
    assert "; otherwise no significant" in result.headline


class Joint(Boat):
    """One update with all measurements of a step."""

    factor = 1.0
    """On the correction of the mean."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        values = super().__call__(observations=observations, controls=controls)
        mean, covariance = values["predicted_mean"][0], values["predicted_covariance"][0]
        parts = [(key, *self.measure(key, mean)) for key in STD if observations.get(f"{key}.present", True)]
        nu = {key: observations[key] - expected for key, _, expected in parts}
        for innovation in nu.values():
            innovation[-1] = wrapped(innovation[-1])
        h = np.concatenate([h for _, h, _ in parts])
        size = h @ covariance @ h.T + np.diag(np.concatenate([np.square(STD[key]) for key, *_ in parts]))
        gain = covariance @ h.T @ np.linalg.inv(size)
        self.mean = mean + self.factor * gain @ np.concatenate(list(nu.values()))
        self.mean[2] = wrapped(self.mean[2])
        self.covariance = covariance - gain @ size @ gain.T
        own = {key: h @ covariance @ h.T + np.diag(np.square(STD[key])) for key, h, _ in parts}
        innovations = {
            "innovation": [nu.get(key) for key in STD],
            "innovation_covariance": [own.get(key) for key in STD],
        }
        return values | innovations | {"estimate_mean": self.mean, "estimate_covariance": self.covariance}


class Half(Joint):
    factor = 0.5


class Certain(Boat):
    """Reports and keeps the predicted covariance."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        values = super().__call__(observations=observations, controls=controls)
        self.covariance = values["predicted_covariance"][0]
        return values | {"estimate_covariance": self.covariance}


@pytest.mark.first(1)
@pytest.mark.parametrize("filter_", [Boat(), Boat(separate=True), Joint()])
def test_updates_and_noise_are_those_of_the_filter(filter_: Boat) -> None:
    """Q is the squares of 1 cm, 2 mrad and 0.1 mrad/s per step; one update after another and all at once."""
    result = equations(filter_)
    assert result.alarms == ()
    assert result.covariance == pytest.approx(0.0, abs=0.01)
    assert result.correction == pytest.approx(0.0, abs=0.01)
    np.testing.assert_allclose(result.process_noise, [0.01, 0.01, 0.002, 0.0001], rtol=0.02)
    np.testing.assert_allclose(result.measurement_noise, [STD["radar"], (*STD["compass"], np.nan)], rtol=0.05)


def test_wrong_updates_are_named() -> None:
    (half,), (certain,) = equations(Half()).alarms, equations(Certain()).alarms
    text = "in updates with radar, compass, the correction of the mean differs from K times the innovation by 50 %"
    assert half == text
    assert certain == "in updates with radar, compass, the reduction of the covariance differs from K H P by 100 %"


class Hidden(Joint):
    """Reports innovations with covariances of a tenth."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        values = super().__call__(observations=observations, controls=controls)
        small = [None if size is None else 0.1 * size for size in values["innovation_covariance"]]
        return values | {"innovation_covariance": small}


def test_covariances_that_are_too_small_are_named() -> None:
    values = replace(equations(Joint()), measurement_lack=np.array([-0.5, 0.0]), process_lack=-0.1)
    assert values.alarms == (
        "the predicted covariance is smaller than F P Fᵀ, as if Q were negative",
        "S of radar is smaller than H P Hᵀ, as if R were negative",
    )
    assert equations(Hidden()).alarms[0].startswith("the Jacobian of radar differs from finite differences by 90 %")


class Silent(Boat):
    """Reports no innovations."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        values = super().__call__(observations=observations, controls=controls)
        return {name: value for name, value in values.items() if not name.startswith("innovation")}


def test_predictions_alone_are_checked_without_innovations() -> None:
    result = equations(Silent(heading_jacobian=0.0))
    assert (result.modalities, result.measurement.size, result.covariance.size) == ((), 0, 0)
    assert result.alarms[0].startswith("the Jacobian of the dynamics differs from finite differences by ")
    assert [table.title for table in result.tables()] == [
        "Jacobians against finite differences",
        "Noise that the covariances contain",
    ]


class Redundant:
    """Updates in turn with sensors of one position (2,), m."""

    def __init__(self, std: tuple[float, ...]) -> None:
        self.std = dict(zip(("front", "rear", "left", "right"), std, strict=False))

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.mean, self.covariance = mean, covariance

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        self.covariance = self.covariance + 0.05**2 * np.eye(2)
        before, innovation = [], []
        for key, std in self.std.items():
            size = self.covariance + std**2 * np.eye(2)
            gain = self.covariance @ np.linalg.inv(size)
            before.append((self.mean, self.covariance))
            innovation.append((observations[key] - self.mean, size))
            self.mean = self.mean + gain @ innovation[-1][0]
            self.covariance = self.covariance - gain @ self.covariance
        return {
            "estimate_mean": self.mean,
            "estimate_covariance": self.covariance,
            "predicted_mean": np.stack([mean for mean, _ in before]),
            "predicted_covariance": np.stack([covariance for _, covariance in before]),
            "innovation": np.stack([nu for nu, _ in innovation]),
            "innovation_covariance": np.stack([size for _, size in innovation]),
        }


@pytest.mark.parametrize("count", [3, 4])
def test_redundant_sensors_have_right_corrections(count: int) -> None:
    """A repeated step has fewer values than there are sensors."""
    filter_ = Redundant((0.1, 0.05, 0.1, 0.2)[:count])
    redundant = bs.Task(
        name="redundant",
        components=(bs.Component("x", "m"), bs.Component("y", "m")),
        observations=dict.fromkeys(filter_.std, (2,)),
        modalities={key: (key,) for key in filter_.std},
        control_size=0,
        dt=0.1,
    )
    rng = np.random.default_rng(0)
    states = np.cumsum(rng.normal(0.0, 0.05, (60, 2)), axis=0)
    readings = {key: states + rng.normal(0.0, std, (60, 2)) for key, std in filter_.std.items()}
    episode = bs.Episode(redundant, states, np.zeros((60, 0)), readings)
    adapter = bs.Adapter(filter_, batched=False, modalities=tuple(filter_.std), initial_std=(0.3, 0.3))
    checkpoint = bs.load_filter(adapter, redundant)
    values = jacobian_statistics(bs.trace(checkpoint, [episode]), checkpoint)
    for key in filter_.std:
        assert values[f"correction slope/{key}/all"] == pytest.approx(1.0, abs=1e-3)

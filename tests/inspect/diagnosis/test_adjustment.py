"""Statistics of modules, adjusted for simulated readings."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.inspect.diagnosis.adjustment import with_adjusted
from beliefscope.inspect.diagnostics.healthy_comparison import compare
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile

READINGS = [f"level/force {i}/all" for i in range(40)]
BIAS, ADJUSTED, POWER = "module bias/image x/all", "module bias/image x/adjusted", "module power/image/adjusted"


def episodes(count: int, rng: np.random.Generator, offset: float = 0.0) -> list[dict[str, float]]:
    """Episodes whose bias follows the first of 40 readings, up to a tenth of its variation."""
    readings = rng.normal(size=(count, len(READINGS)))
    bias = readings[:, 0] + 0.1 * rng.normal(size=count) + offset
    power = np.exp(readings[:, 1])
    columns = {**dict(zip(READINGS, readings.T, strict=True)), BIAS: bias, "module power/image/all": power}
    return [{name: float(values[i]) for name, values in columns.items()} for i in range(count)]


def record(rows: list[dict[str, float]]) -> HealthyProfile:
    return HealthyProfile("simulated", len(rows), None, {n: np.array([row[n] for row in rows]) for n in rows[0]})


def sensors(rows: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{name: row[name] for name in READINGS} for row in rows]


def test_a_bias_within_the_variation_of_the_readings_shows() -> None:
    rng = np.random.default_rng(0)
    profile, tested = record(episodes(120, rng)), episodes(6, rng, offset=0.8)
    adjusted, rows = with_adjusted(profile, tested, sensors(tested))
    assert compare(profile, tested).p_value > 0.02
    comparison = compare(adjusted, rows)
    assert comparison.p_value < 0.001
    assert comparison.deviations[0].statistic == ADJUSTED
    assert comparison.deviations[0].value == pytest.approx(0.8, abs=0.3)
    assert comparison.deviations[0].text.startswith("bias of the measurement model of image (x), given the readings is")


def test_values_of_the_record_vary_as_much_as_those_of_new_episodes() -> None:
    rng = np.random.default_rng(1)
    tested = episodes(2000, rng)
    profile, rows = with_adjusted(record(episodes(80, rng)), tested, sensors(tested))
    for name, scale in ((ADJUSTED, np.array), (POWER, np.log)):
        healthy, new = scale(profile.statistics[name]), scale([row[name] for row in rows])
        assert np.std(healthy) == pytest.approx(np.std(new), rel=0.25)
        assert np.std(healthy) < 0.75


def test_a_faulty_reading_predicts_nothing() -> None:
    rng = np.random.default_rng(2)
    profile, tested = record(episodes(120, rng)), episodes(6, rng)
    faulty = [{**row, READINGS[0]: 50.0, READINGS[2]: float("nan")} for row in tested]
    _, rows = with_adjusted(profile, faulty, sensors(faulty))
    for row in rows:
        assert abs(row[ADJUSTED] - row[BIAS]) < 1.0


def test_modules_without_readings_are_not_adjusted() -> None:
    rng = np.random.default_rng(3)
    rows = [{BIAS: row[BIAS]} for row in episodes(20, rng)]
    profile = record(rows)
    assert with_adjusted(profile, rows[:2], [{}, {}]) == (profile, rows[:2])

"""Alarms of the diagnosis on simulated statistics with light and heavy tails."""

from __future__ import annotations

from inspect import signature

import numpy as np
import pytest

from beliefscope.app.cli.commands.diagnose import Options
from beliefscope.inspect.diagnosis.case import ALARM_RATE, checked_alarm_rate
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnostics.healthy_comparison import compare, with_critical_values
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile

NAMES = [f"module bias/image {i}/all" for i in range(10)] + [f"frozen/image {i}/all" for i in range(10)]
RATE = 0.05


def rows(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 20): ten normal statistics, and ten that are rarely nonzero."""
    rare = rng.exponential(size=(count, 10)) * (rng.random((count, 10)) < 0.05)
    return np.concatenate([rng.normal(size=(count, 10)), rare], axis=1)


def alarms(healthy: np.ndarray, tested: np.ndarray) -> list[str]:
    profile = HealthyProfile("simulated", len(healthy), None, dict(zip(NAMES, healthy.T, strict=True)))
    comparison = compare(profile, [dict(zip(NAMES, row.tolist(), strict=True)) for row in tested])
    if comparison.p_value > RATE:
        return []
    return [d.statistic for d in with_critical_values(profile, comparison, RATE) if d.alarm]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3, 8])
def test_healthy_samples_rarely_raise_an_alarm(count: int) -> None:
    rng = np.random.default_rng(count)
    raised = [bool(alarms(rows(60, rng), rows(count, rng))) for _ in range(60)]
    assert np.mean(raised) <= 0.12  # 5 % expected; exceeded with probability 2 %


def test_heavy_tails_of_other_statistics_do_not_hide_a_fault() -> None:
    rng = np.random.default_rng(0)
    detections = 0
    for _ in range(20):
        tested = rows(6, rng)
        tested[:, 3] += 2.5
        detections += NAMES[3] in alarms(rows(60, rng), tested)
    assert detections >= 17


def test_a_single_episode_does_not_hide_its_own_deviation() -> None:
    rng = np.random.default_rng(1)
    names, detections = NAMES[:10], 0
    for _ in range(20):
        healthy, tested = rng.normal(size=(60, 10)), rng.normal(size=(1, 10))
        tested[0, 3] += 10.0
        profile = HealthyProfile("simulated", 60, None, dict(zip(names, healthy.T, strict=True)))
        comparison = compare(profile, [dict(zip(names, tested[0].tolist(), strict=True))])
        named = [d.statistic for d in with_critical_values(profile, comparison, RATE) if d.alarm]
        detections += comparison.p_value <= RATE and named == [names[3]]
    assert detections >= 19


def test_a_smaller_alarm_rate_keeps_the_scale_of_deviations() -> None:
    rng = np.random.default_rng(2)
    healthy, tested = rows(60, rng), rows(6, rng)
    tested[:, 3] += 2.5
    tested[:, 5] += 1.7
    profile = HealthyProfile("simulated", 60, None, dict(zip(NAMES, healthy.T, strict=True)))
    comparison = compare(profile, [dict(zip(NAMES, row.tolist(), strict=True)) for row in tested])
    strict, usual, lenient = (with_critical_values(profile, comparison, rate) for rate in (0.001, 0.05, 0.5))
    assert strict == usual
    assert [d.t for d in lenient] == [d.t for d in usual]
    assert {d.statistic for d in usual if d.alarm} < {d.statistic for d in lenient if d.alarm}


def test_the_command_has_the_default_alarm_rate_of_the_library() -> None:
    option = signature(Options).parameters["alarm_rate"].default
    assert (option.default, signature(diagnose).parameters["alarm_rate"].default) == (None, None)
    assert f"Default: {ALARM_RATE}; for one episode and a healthy record of n < 49 episodes, 1 / (n + 1)" in option.help
    assert (checked_alarm_rate(49, 1), checked_alarm_rate(48, 1)) == (ALARM_RATE, 1 / 49)

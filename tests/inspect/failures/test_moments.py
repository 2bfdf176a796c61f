"""Failures are found where they were planted, once each, in whatever order the episodes come."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.inspect.diagnostics.weight_audit import position_regret
from beliefscope.inspect.failures.moments import failures_of, find_failures, stretches
from beliefscope.inspect.failures.step_scores import GROUPS, Survey, disagreement, scores_of
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, trace

EPISODES = 5
CUT = 60  # steps: enough for every group, and quick


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    return load_checkpoint(shipped("push", "crossmodal-pf"))


@pytest.fixture(scope="module")
def episodes() -> dict[int, Episode]:
    with open_dataset(sample_path("push")) as data:
        return {index: shortened(data[index]) for index in data.held_out()[:EPISODES]}


def shortened(episode: Episode) -> Episode:
    arrays = {name: getattr(episode, name)[:CUT] for name in ("states", "controls", "contact", "qpos")}
    return replace(episode, **arrays, observations={k: v[:CUT] for k, v in episode.observations.items()})


@pytest.fixture(scope="module")
def traces(checkpoint: Checkpoint, episodes: dict[int, Episode]) -> list[Trace]:
    return [trace(checkpoint, episode, index, particles=50) for index, episode in episodes.items()]


@pytest.fixture(scope="module")
def survey(traces: list[Trace]) -> Survey:
    return Survey.of(traces)


def with_contact(one: Trace, contact: np.ndarray) -> Trace:
    return replace(one, episode=replace(one.episode, contact=contact))


def shifted(one: Trace, first: int, last: int, metres: float) -> Trace:
    """The fused estimate moved off the truth over a stretch, the most in its middle; exact everywhere else."""
    mean = one.episode.states.copy()
    hump = 1.0 + np.sin(np.linspace(0.0, np.pi, last - first + 1))
    mean[first : last + 1, measures.task_of(one).map_indices[0]] += metres * hump
    return replace(one, estimate_mean=mean)


def test_a_planted_stretch_is_the_first_moment_at_its_steps(traces: list[Trace]) -> None:
    contact = np.zeros(CUT, dtype=bool)
    contact[40:] = True
    bad = shifted(with_contact(traces[2], contact), 37, 47, 1.0)
    found = failures_of(Survey.of([*traces[:2], bad, *traces[3:]]))
    worst = found.moments[0]
    assert (worst.episode, worst.first, worst.last, worst.step) == (bad.episode_index, 37, 47, 42)
    assert worst.group == "contact made"
    assert worst.score == pytest.approx(2.0)  # 1 m x (1 + 1)
    assert f"step 42 of episode {bad.episode_index}" in found.verdict
    lost = failures_of(Survey.of([shifted(with_contact(traces[2], ~contact), 37, 47, 1.0)]))
    assert lost.moments[0].group == "contact lost"


def test_broken_sensors_are_found_in_their_episode_and_group(
    checkpoint: Checkpoint, episodes: dict[int, Episode], traces: list[Trace]
) -> None:
    index = traces[1].episode_index
    faults = Faults.parse("blackout=1:from=35:to=55")
    broken = trace(checkpoint, episodes[index], index, particles=50, faults=faults)
    steady = with_contact(broken, np.ones(CUT, dtype=bool))
    others = [replace(one, faults=faults) for k, one in enumerate(traces) if k != 1]
    found = failures_of(Survey.of([steady, *others]))
    worst = found.moments[0]
    assert worst.episode == index
    assert 35 <= worst.step <= 55
    assert worst.group == "blackout"
    group = next(g for g in found.groups if g.name == "blackout")
    assert group.steps == measures.blackout(steady).sum() > 0
    assert group.lift > 1
    assert group.inside > group.outside


@pytest.mark.parametrize("seed", range(20))
def test_moments_never_overlap_and_cover_what_is_high(seed: int) -> None:
    rng = np.random.default_rng(seed)
    episode = np.repeat(np.arange(6), rng.integers(1, 60, 6))
    high, bridge = rng.random(len(episode)) < rng.choice([0.05, 0.3, 0.9]), int(rng.integers(0, 8))
    spans = stretches(high, episode, bridge)
    inside = np.zeros(len(high), dtype=int)
    for first, last in spans:
        inside[first : last + 1] += 1
        assert episode[first] == episode[last]
        assert high[first]
        assert high[last]
    assert inside.max(initial=0) <= 1
    assert (inside >= high).all()
    for (_, before), (after, _) in pairwise(spans):
        assert after - before > bridge + 1 or episode[after] != episode[before]
    gap = np.diff(np.flatnonzero(inside & ~high), prepend=-2)
    assert not spans or longest_run(gap) <= bridge


def longest_run(gaps: np.ndarray) -> int:
    longest = run = 0
    for gap in gaps:
        run = run + 1 if gap == 1 else 1
        longest = max(longest, run)
    return longest


@pytest.mark.parametrize("by", ["error", "nees", "ess", "disagreement", "regret"])
def test_the_order_of_the_episodes_changes_nothing(traces: list[Trace], survey: Survey, by: str) -> None:
    order = np.random.default_rng(1).permutation(len(traces))
    assert failures_of(Survey.of(traces[i] for i in order), by).to_dict() == failures_of(survey, by).to_dict()


@pytest.mark.parametrize("by", ["error", "nees", "ess", "disagreement", "regret"])
def test_moments_are_ranked_and_say_what_the_trace_says(traces: list[Trace], survey: Survey, by: str) -> None:
    found = failures_of(survey, by)
    assert [m.score for m in found.moments] == sorted((m.score for m in found.moments), reverse=True)
    by_index = {one.episode_index: one for one in traces}
    for moment in found.moments:
        one = by_index[moment.episode]
        score = scores_of(survey.task)[by].of(one)
        assert moment.first <= moment.step <= moment.last
        assert moment.score == score[moment.step] == score[moment.first : moment.last + 1].max() > found.threshold
        np.testing.assert_array_equal(moment.error, measures.position_error(one)[moment.step])
        np.testing.assert_array_equal(moment.nees, measures.nees(one)[moment.step])
        assert moment.ess == one.effective_sample_size[moment.step]  # type: ignore[index]
        assert moment.acting is not None
        assert moment.acting.sum() == pytest.approx(1.0, abs=1e-5)  # float32 softmax
    assert json.loads(json.dumps(found.to_dict()))["moments"][0]["step"] == found.moments[0].step


def test_groups_share_out_all_steps_and_moments(survey: Survey) -> None:
    found = failures_of(survey, "disagreement")
    assert sum(g.steps for g in found.groups) == found.steps == EPISODES * CUT
    assert sum(g.moments for g in found.groups) == len(found.moments)
    for g in found.groups:
        assert g.moments == len(found.worst(group=g.name))
        assert g.lift == pytest.approx((g.moments / len(found.moments)) / (g.steps / found.steps))
        overall = survey.scores["disagreement"].mean()  # the mean is the mixture of inside and outside
        assert g.share * g.inside + (1 - g.share) * g.outside == pytest.approx(overall)
    assert [g.name for g in found.groups] == [name for name in GROUPS if name in {g.name for g in found.groups}]


def test_events_are_recent_for_half_a_second(traces: list[Trace]) -> None:
    contact = np.zeros(CUT, dtype=bool)
    contact[20:30] = True
    happening = Survey.of([with_contact(traces[0], contact)]).happening
    assert traces[0].episode.dt == 0.1
    assert np.flatnonzero(happening["contact made"]).tolist() == [20, 21, 22, 23, 24]
    assert np.flatnonzero(happening["contact lost"]).tolist() == [30, 31, 32, 33, 34]
    assert np.flatnonzero(happening["start"]).tolist() == list(range(30))


def test_fast_motion_is_the_fastest_twentieth_of_each_speed(traces: list[Trace], survey: Survey) -> None:
    states = np.stack([one.episode.states[:, list(survey.task.map_indices)] for one in traces])
    speed = np.linalg.norm(np.diff(states, axis=1, prepend=states[:, :1]), axis=-1).ravel()
    fastest = speed > np.quantile(speed, 0.95)
    assert survey.happening["fast motion"][fastest].all()
    speeds = 2  # the puck's and the hand's
    assert survey.happening["fast motion"].mean() <= speeds * 0.05 + 1e-9


def test_disagreement_is_one_where_covariances_explain_the_distance(traces: list[Trace]) -> None:
    one, n = traces[0], 2
    covariance = np.broadcast_to(0.01 * np.eye(n, dtype=np.float32), one.modality_covariance.shape)
    mean = np.zeros_like(one.modality_mean)
    mean[:, 1] = np.sqrt(0.02)  # each component sqrt(S_1 + S_2) apart
    got = disagreement(replace(one, modality_mean=mean, modality_covariance=covariance))
    np.testing.assert_allclose(got, 1.0, atol=1e-5)  # the floor of a covariance, 1e-8 of 0.02


def test_regret_is_what_a_scan_over_all_shares_finds(traces: list[Trace]) -> None:
    one = traces[0]
    off = measures.errors(one)
    shares = np.linspace(0.0, 1.0, 2001)[:, None, None]
    mixed = np.linalg.norm(shares * off[:, 0] + (1 - shares) * off[:, 1], axis=-1).min(axis=0)
    expected = measures.position_error(one)[:, -1] - mixed
    apart = np.linalg.norm(off[:, 0] - off[:, 1], axis=-1).max()
    np.testing.assert_allclose(position_regret(one), expected, atol=apart / 4000)  # half a cell of the scan
    assert one.acting is not None
    assert one.acting.shape[-1] == 1
    each = replace(one, acting=np.repeat(one.acting, 2, axis=-1))  # a weight for each component can do no worse
    assert (position_regret(each) >= position_regret(one) - 1e-12).all()


def test_angles_have_a_score_of_their_own_and_wrap() -> None:
    door = load_checkpoint(shipped("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        one = trace(door, shortened(data[9]), 9)
    turned = one.estimate_mean.copy()
    turned[50, 2] += 2 * np.pi - 0.5
    found = failures_of(Survey.of([replace(one, estimate_mean=turned)]), "angle")
    assert found.moments[0].step == 50
    assert found.moments[0].score == pytest.approx(0.5, abs=0.1)
    assert found.unit == "rad"
    assert "deg at step 50" in found.verdict
    with pytest.raises(BadInput, match="no failures by ess: this filter has no particles"):
        failures_of(Survey.of([one]), "ess")


def test_found_in_the_very_traces_of_the_page(checkpoint: Checkpoint, episodes: dict[int, Episode]) -> None:
    seen: list[float] = []
    two = dict(list(episodes.items())[:2])
    found = find_failures(checkpoint, two, seed=3, particles=20, progress=seen.append)
    moment = found.moments[0]
    alone = trace(checkpoint, two[moment.episode], moment.episode, seed=3, particles=20)
    assert moment.score == measures.position_error(alone)[moment.step, -1]
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    assert found.episodes == 2


def test_figures_and_tables_show_it(survey: Survey) -> None:
    found = failures_of(survey, "nees")
    groups, worst = found.tables()
    assert len(groups.rows) == len(found.groups)
    assert all(len(row) == len(table.columns) for table in (groups, worst) for row in table.rows)
    assert len(worst.rows) == min(20, len(found.moments))
    (axes,) = found.plot().axes
    assert len(axes.lines) == len(found.plots()[0].lines) >= 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda traces: [], "at least one trace"),
        (lambda traces: [traces[0], traces[0]], "two traces are of episode"),
        (lambda traces: [traces[0], replace(traces[1], seed=1)], "traces of seed '0' and '1'"),
    ],
)
def test_traces_that_do_not_belong_together(traces: list[Trace], change, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadInput, match=message):
        Survey.of(change(traces))


def test_unknown_names_say_what_there_is(checkpoint: Checkpoint, survey: Survey) -> None:
    with pytest.raises(BadInput, match=r"'eror' does not exist\. Available: error, nees, ess, disagreement, regret"):
        find_failures(checkpoint, {}, by="eror")
    with pytest.raises(BadInput, match=r"group 'contact' does not exist\. Available: contact made, contact lost"):
        failures_of(survey).worst(group="contact")


def test_nothing_stands_out_where_all_is_alike(traces: list[Trace]) -> None:
    exact = replace(traces[0], estimate_mean=traces[0].episode.states)
    found = failures_of(Survey.of([exact]))
    assert found.moments == ()
    assert found.verdict == f"No moment of 1 episode, {CUT} steps, by position error stands out."
    assert found.tables()[0].rows[0][2] == 0

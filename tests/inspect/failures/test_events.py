"""Failure search: planted failures, merging of events, ranking and phases."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.inspect.diagnostics.weight_steps import main_regret
from beliefscope.inspect.failures.events import event_spans, failures_of, find_failures
from beliefscope.inspect.failures.step_scores import EpisodeScores, Survey, disagreement, phases_of, scores_of
from beliefscope.inspect.failures.survey import BLOCK, survey_of
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, trace

EPISODES = 5
CUT = 60  # steps; enough for all phases


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    return load_checkpoint(pretrained_path("push", "crossmodal-pf"))


@pytest.fixture(scope="module")
def episodes() -> dict[int, Episode]:
    with open_dataset(sample_path("push")) as data:
        return {index: shortened(data[index]) for index in data.held_out()[:EPISODES]}


def survey_over(traces: Iterable[Trace]) -> Survey:
    return Survey.from_episodes(map(EpisodeScores.from_trace, traces))


def shortened(episode: Episode, steps: int = CUT) -> Episode:
    arrays = {name: getattr(episode, name)[:steps] for name in ("states", "controls", "contact", "qpos")}
    return replace(episode, **arrays, observations={k: v[:steps] for k, v in episode.observations.items()})


@pytest.fixture(scope="module")
def traces(checkpoint: Checkpoint, episodes: dict[int, Episode]) -> list[Trace]:
    return [trace(checkpoint, episode, index, particles=50) for index, episode in episodes.items()]


@pytest.fixture(scope="module")
def survey(traces: list[Trace]) -> Survey:
    return survey_over(traces)


def with_contact(run: Trace, contact: np.ndarray) -> Trace:
    return replace(run, episode=replace(run.episode, contact=contact))


def shifted(run: Trace, first: int, last: int, metres: float) -> Trace:
    """Exact estimates with an error over some steps that is largest in their middle."""
    mean = run.episode.states.copy()
    hump = 1.0 + np.sin(np.linspace(0.0, np.pi, last - first + 1))
    mean[first : last + 1, run.task.map_indices[0]] += metres * hump
    return replace(run, estimate_mean=mean)


def test_planted_error_is_the_worst_event(traces: list[Trace]) -> None:
    contact = np.zeros(CUT, dtype=bool)
    contact[40:] = True
    shifted_trace = shifted(with_contact(traces[2], contact), 37, 47, 1.0)
    failures = failures_of(survey_over([*traces[:2], shifted_trace, *traces[3:]]))
    worst = failures.events[0]
    assert (worst.episode, worst.first, worst.last, worst.step) == (shifted_trace.episode_index, 37, 47, 42)
    assert worst.phase == "contact made"
    assert worst.score == pytest.approx(2.0)  # 1 m x (1 + 1)
    assert f"step 42 of episode {shifted_trace.episode_index}" in failures.verdict
    assert measures.UPDATES_NOTE not in failures.verdict
    assert measures.UPDATES_NOTE in replace(failures, by="disagreement").verdict
    release = failures_of(survey_over([shifted(with_contact(traces[2], ~contact), 37, 47, 1.0)]))
    assert release.events[0].phase == "contact lost"


def test_injected_faults_are_found_in_their_episode_and_phase(
    checkpoint: Checkpoint, episodes: dict[int, Episode], traces: list[Trace]
) -> None:
    index = traces[1].episode_index
    faults = Faults.parse("blackout=1:from=35:to=55")
    faulty = trace(checkpoint, episodes[index], index, particles=50, faults=faults)
    steady = with_contact(faulty, np.ones(CUT, dtype=bool))
    others = [replace(run, faults=faults) for k, run in enumerate(traces) if k != 1]
    failures = failures_of(survey_over([steady, *others]))
    worst = failures.events[0]
    assert worst.episode == index
    assert 35 <= worst.step <= 55
    assert worst.phase == "blackout"
    phase = next(g for g in failures.phases if g.name == "blackout")
    assert phase.steps == measures.blackout(steady).sum() > 0
    assert phase.lift > 1
    assert phase.inside > phase.outside


@pytest.mark.parametrize("seed", range(20))
def test_events_are_disjoint_and_cover_high_steps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    episode = np.repeat(np.arange(6), rng.integers(1, 60, 6))
    high, gap_limit = rng.random(len(episode)) < rng.choice([0.05, 0.3, 0.9]), int(rng.integers(0, 8))
    spans = event_spans(high, episode, gap_limit, np.arange(len(episode), dtype=float))
    inside = np.zeros(len(high), dtype=int)
    for first, last in spans:
        inside[first : last + 1] += 1
        assert episode[first] == episode[last]
        assert high[first]
        assert high[last]
    assert inside.max(initial=0) <= 1
    assert (inside >= high).all()
    for (_, before), (after, _) in pairwise(spans):
        assert after - before > gap_limit + 1 or episode[after] != episode[before]
    gap = np.diff(np.flatnonzero(inside & ~high), prepend=-2)
    assert not spans or longest_run(gap) <= gap_limit


def longest_run(gaps: np.ndarray) -> int:
    longest = run = 0
    for gap in gaps:
        run = run + 1 if gap == 1 else 1
        longest = max(longest, run)
    return longest


@pytest.mark.parametrize("by", ["error", "nees", "ess", "disagreement", "regret"])
def test_order_of_episodes_is_irrelevant(traces: list[Trace], survey: Survey, by: str) -> None:
    order = np.random.default_rng(1).permutation(len(traces))
    assert failures_of(survey_over(traces[i] for i in order), by).to_dict() == failures_of(survey, by).to_dict()


@pytest.mark.parametrize("by", ["error", "nees", "ess", "disagreement", "regret"])
def test_events_are_ranked_and_match_the_trace(traces: list[Trace], survey: Survey, by: str) -> None:
    failures = failures_of(survey, by)
    assert [m.score for m in failures.events] == sorted((m.score for m in failures.events), reverse=True)
    by_index = {run.episode_index: run for run in traces}
    for event in failures.events:
        run = by_index[event.episode]
        score = scores_of(survey.task)[by].values(run)
        assert event.first <= event.step <= event.last
        assert event.score == score[event.step] == np.nanmax(score[event.first : event.last + 1]) > failures.threshold
        np.testing.assert_array_equal(event.error, measures.main_error(run)[event.step])
        np.testing.assert_array_equal(event.nees, measures.nees(run)[event.step])
        assert event.ess == run.effective_sample_size[event.step]  # type: ignore[index]
        assert event.effective_weights is not None
        assert event.effective_weights.sum() == pytest.approx(1.0, abs=1e-5)  # float32 softmax
    assert json.loads(json.dumps(failures.to_dict()))["events"][0]["step"] == failures.events[0].step


def test_phases_partition_steps_and_events(survey: Survey) -> None:
    failures = failures_of(survey, "disagreement")
    assert sum(g.steps for g in failures.phases) == failures.steps == EPISODES * CUT
    assert sum(g.events for g in failures.phases) == len(failures.events)
    for g in failures.phases:
        assert g.events == len(failures.worst(phase=g.name))
        assert g.lift == pytest.approx((g.events / len(failures.events)) / (g.steps / failures.steps))
        overall = survey.scores["disagreement"].mean()  # mean of inside and outside, weighted by share
        assert g.share * g.inside + (1 - g.share) * g.outside == pytest.approx(overall)
    assert [g.name for g in failures.phases] == [
        name for name in phases_of(survey.task) if name in {g.name for g in failures.phases}
    ]


def test_regret_in_the_warm_up_is_no_failure(survey: Survey) -> None:
    """The belief starts at the truth, so small weights errors there are a large share of the regret."""
    failures = failures_of(survey, "regret")
    assert "start" not in {phase.name for phase in failures.phases}
    assert min(event.step for event in failures.events) >= 30
    assert sum(phase.share for phase in failures.phases) == pytest.approx(1.0)
    assert "start" in {phase.name for phase in failures_of(survey, "error").phases}


def test_contact_changes_last_half_a_second(traces: list[Trace]) -> None:
    contact = np.zeros(CUT, dtype=bool)
    contact[20:30] = True
    phases = survey_over([with_contact(traces[0], contact)]).phases
    assert traces[0].episode.dt == 0.1
    assert np.flatnonzero(phases["contact made"]).tolist() == [20, 21, 22, 23, 24]
    assert np.flatnonzero(phases["contact lost"]).tolist() == [30, 31, 32, 33, 34]
    assert np.flatnonzero(phases["start"]).tolist() == list(range(30))


def timed(run: Trace, times: np.ndarray) -> Trace:
    return replace(run, episode=replace(run.episode, time=times))


def test_timestamps_give_events_and_phases_their_times(traces: list[Trace]) -> None:
    """Steps of 0.1 s, then a gap of 3 s, then steps of 0.02 s."""
    contact = np.zeros(CUT, dtype=bool)
    contact[20:30] = True
    duration = np.r_[np.full(40, 0.1), np.full(CUT - 40, 0.02)]
    duration[26] = 3.0
    times = np.cumsum(duration) - duration[0]
    shifted_trace = shifted(with_contact(traces[0], contact), 37, 47, 1.0)
    survey = survey_over([timed(shifted_trace, times)])
    assert survey_over([shifted_trace]).time is None
    assert np.flatnonzero(survey.phases["contact made"]).tolist() == [20, 21, 22, 23, 24]
    contact[20:25], contact[25:45] = False, True
    brief = timed(with_contact(traces[0], contact), times)
    assert np.flatnonzero(survey_over([brief]).phases["contact made"]).tolist() == [25]  # then 3 s have passed
    assert np.flatnonzero(survey_over([brief]).phases["contact lost"]).tolist() == list(range(45, CUT))  # 15 of 0.02 s
    before = failures_of(survey_over([shifted_trace, *traces[1:]]))
    after = failures_of(survey_over([timed(shifted_trace, times), *traces[1:]]))
    worst = after.events[0]
    assert (worst.first, worst.last, worst.step) == (37, 47, 42)
    assert (before.events[0].time, before.events[0].first_time) == (None, None)
    assert (worst.first_time, worst.last_time, worst.time) == (times[37], times[47], times[42])
    assert f"at step 42 ({times[42]:.2f} s) of episode" in after.verdict
    assert " s)" not in before.verdict
    columns = after.tables()[1].columns
    assert columns[:7] == ("episode", "step", "from", "to", "time (s)", "from (s)", "to (s)")
    assert after.tables()[1].rows[0][4:7] == (times[42], times[37], times[47])
    assert before.tables()[1].columns == tuple(
        name for name in columns if name not in {"time (s)", "from (s)", "to (s)"}
    )
    assert all(len(row) == len(columns) for row in after.tables()[1].rows)


def test_regular_timestamps_change_no_event(traces: list[Trace]) -> None:
    regular = [timed(run, run.episode.dt * np.arange(CUT)) for run in traces]
    plain, with_times = (failures_of(survey_over(runs)) for runs in (traces, regular))
    spans = [
        [(event.episode, event.first, event.last, event.step, event.phase, event.score) for event in failures.events]
        for failures in (plain, with_times)
    ]
    assert spans[0] == spans[1]
    mixed = failures_of(survey_over([*traces[:2], *regular[2:]]))
    without = {event.episode for event in mixed.events if event.time is None}
    assert without <= {run.episode_index for run in traces[:2]}
    assert mixed.timed


def test_intervals_merge_across_half_a_second_not_across_long_gaps() -> None:
    high = np.array([1, 0, 1, 0, 1, 1], bool)
    episode = np.zeros(6, int)
    assert event_spans(high, episode, 5, np.arange(6.0)) == [(0, 5)]
    assert event_spans(high, episode, 5, np.array([0.0, 1, 2, 30, 60, 90])) == [(0, 2), (4, 5)]


def test_fast_motion_is_the_fastest_twentieth_of_each_speed(traces: list[Trace], survey: Survey) -> None:
    states = np.stack([run.episode.states[:, list(survey.task.map_indices)] for run in traces])
    speed = np.linalg.norm(np.diff(states, axis=1, prepend=states[:, :1]), axis=-1).ravel()
    fastest = speed > np.quantile(speed, 0.95)
    assert survey.phases["fast motion"][fastest].all()
    speeds = 2  # puck and end effector
    assert survey.phases["fast motion"].mean() <= speeds * 0.05 + 1e-9


def test_disagreement_is_one_if_covariances_match_the_distance(traces: list[Trace]) -> None:
    run, n = traces[0], 2
    covariance = np.broadcast_to(0.01 * np.eye(n, dtype=np.float32), run.modality_covariance.shape)
    mean = np.zeros_like(run.modality_mean)
    mean[:, 1] = np.sqrt(0.02)  # components differ by sqrt(S_1 + S_2)
    got = disagreement(replace(run, modality_mean=mean, modality_covariance=covariance))
    np.testing.assert_allclose(got, 1.0, atol=1e-5)  # covariance floor


def test_regret_equals_a_scan_over_weights(traces: list[Trace]) -> None:
    run = traces[0]
    errors = measures.errors(run)
    shares = np.linspace(0.0, 1.0, 2001)[:, None, None]
    mixed = np.linalg.norm(shares * errors[:, 0] + (1 - shares) * errors[:, 1], axis=-1).min(axis=0)
    expected = measures.main_error(run)[:, -1] - mixed
    distance = np.linalg.norm(errors[:, 0] - errors[:, 1], axis=-1).max()
    np.testing.assert_allclose(main_regret(run), expected, atol=distance / 4000)  # half the resolution of the scan
    assert run.effective_weights is not None
    assert run.effective_weights.shape[-1] == 1
    each = replace(
        run, effective_weights=np.repeat(run.effective_weights, 2, axis=-1)
    )  # a weight for each component can do no worse
    assert (main_regret(each) >= main_regret(run) - 1e-12).all()


def test_angles_have_a_score_and_wrap() -> None:
    door = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        run = trace(door, shortened(data[9]), 9)
    turned = run.estimate_mean.copy()
    turned[50, 2] += 2 * np.pi - 0.5
    failures = failures_of(survey_over([replace(run, estimate_mean=turned)]), "angle")
    assert failures.events[0].step == 50
    assert failures.events[0].score == pytest.approx(0.5, abs=0.1)
    assert failures.unit == "rad"
    assert "deg at step 50" in failures.verdict
    with pytest.raises(BadInput, match="no score 'ess': this filter has no particles"):
        failures_of(survey_over([run]), "ess")


def test_a_score_that_does_not_apply_is_refused_after_the_first_block() -> None:
    feature = load_checkpoint(pretrained_path("door", "feature-ekf"))
    progress: list[float] = []
    with open_dataset(sample_path("door")) as data, pytest.raises(BadInput, match="no score 'regret'"):
        find_failures(feature, dict.fromkeys(range(40), shortened(data[9])), by="regret", progress=progress.append)
    assert max(progress, default=0.0) <= 0.5


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_episodes_run_together_have_the_scores_of_single_traces(episodes: dict[int, Episode], name: str) -> None:
    filter_ = load_checkpoint(pretrained_path("push", name))
    members = episodes | {999: shortened(next(iter(episodes.values())), CUT // 2)}
    faults = Faults.parse("blackout=0.4,force_bias:x=5")
    survey = survey_of(filter_, members, members, faults=faults)
    for index, episode in members.items():
        single = survey_over([trace(filter_, episode, index, faults=faults)])
        np.testing.assert_allclose(survey.error[survey.episode == index], single.error, rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(survey.nees[survey.episode == index], single.nees, rtol=1e-2)  # float32 covariances


@pytest.mark.long
@pytest.mark.slow
def test_values_do_not_depend_on_the_number_of_processes() -> None:
    filter_ = load_checkpoint(pretrained_path("push", "crossmodal-ekf"))
    with open_dataset(sample_path("push")) as data:
        serial, parallel = (survey_of(filter_, data, range(BLOCK + 1), workers=workers) for workers in (1, 2))
    assert serial.phases.keys() == parallel.phases.keys()
    for name, values in serial.scores.items():
        np.testing.assert_array_equal(values, parallel.scores[name])
    np.testing.assert_array_equal(serial.phase_index, parallel.phase_index)


def test_failures_match_the_traces(checkpoint: Checkpoint, episodes: dict[int, Episode]) -> None:
    progress: list[float] = []
    two = dict(list(episodes.items())[:2])
    failures = find_failures(checkpoint, two, seed=3, particles=20, progress=progress.append)
    event = failures.events[0]
    expected = trace(checkpoint, two[event.episode], event.episode, seed=3, particles=20)
    assert event.score == measures.main_error(expected)[event.step, -1]
    assert progress == sorted(progress)
    assert progress[-1] == 1.0
    assert failures.episodes == 2


def test_figures_and_tables(survey: Survey) -> None:
    failures = failures_of(survey, "nees")
    phases, worst = failures.tables()
    assert len(phases.rows) == len(failures.phases)
    assert all(len(row) == len(table.columns) for table in (phases, worst) for row in table.rows)
    assert len(worst.rows) == min(20, len(failures.events))
    (axes,) = failures.plot().axes
    assert len(axes.lines) == len(failures.plots()[0].lines) >= 2


def test_the_table_of_a_filter_without_weights_and_updates_has_none(traces: list[Trace]) -> None:
    runs = [replace(run, weights=None, effective_weights=None) for run in traces]
    failures = failures_of(survey_over(runs), "error")
    events = [replace(event, error=np.where(np.arange(3) < 2, np.nan, event.error)) for event in failures.events]
    table = replace(failures, events=tuple(events)).tables()[-1]
    assert [name for name in table.columns if name.endswith(("d (cm)", "e (cm)", "(%)"))] == ["fused (cm)"]
    assert {len(row) for row in table.rows} == {len(table.columns)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda traces: [], "at least one trace"),
        (lambda traces: [traces[0], traces[0]], "two traces of episode"),
        (lambda traces: [traces[0], replace(traces[1], seed=1)], "traces differ in seed, '0' and '1'"),
    ],
)
def test_inconsistent_traces_are_refused(traces: list[Trace], change, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadInput, match=message):
        survey_over(change(traces))


def test_unknown_names_list_the_available_ones(checkpoint: Checkpoint, survey: Survey) -> None:
    with pytest.raises(
        BadInput, match=r"'eror' of task .* does not exist\. Available: error, nees, ess, disagreement, regret"
    ):
        find_failures(checkpoint, {}, by="eror")
    with pytest.raises(BadInput, match=r"phase 'contact' does not exist\. Available: contact made, contact lost"):
        failures_of(survey).worst(phase="contact")


def test_faults_after_all_steps_are_refused(checkpoint: Checkpoint, episodes: dict[int, Episode]) -> None:
    """They would change nothing, and the results would be those of clean episodes."""
    faults, longest = Faults.parse(f"blackout:from={CUT}"), list(episodes.values())
    message = rf"fault blackout:from={CUT} starts after the last step, {CUT - 1}"
    with pytest.raises(BadInput, match=message):
        find_failures(checkpoint, episodes, faults=faults)
    with pytest.raises(BadInput, match=message):
        evaluate(checkpoint.filter, longest, faults=faults)


def test_exact_estimates_have_no_events(traces: list[Trace]) -> None:
    exact = replace(traces[0], estimate_mean=traces[0].episode.states)
    failures = failures_of(survey_over([exact]))
    assert failures.events == ()
    assert failures.verdict == f"No events in 1 episode, {CUT} steps, by position error."
    assert failures.tables()[0].rows[0][2] == 0

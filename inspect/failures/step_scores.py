"""Scores and phases of every step of a data set, from which failures are ranked."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.diagnostics.weight_steps import main_regret
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array, Mask
from beliefscope.inspect.trace import Trace

RECENT = 0.5
"""s, duration for which a change of contact counts as a phase."""

ROUNDING = 1e-6
"""Steps: errors of positions that are computed from times."""

GROUP = "group "
"""Prefix of the columns of groups of covariates."""

FAST = 0.95
"""Quantile of the speeds in the data set above which a step is fast motion."""

OTHER = "other steps"
"""Phase of the steps of no other phase."""

COLUMNS = ("episode", "step", "position", "error", "angle_error", "nees", "ess", "beta", "effective_weights")
"""Fields of a survey that are columns of its episodes."""


def phases_of(task: Task) -> tuple[str, ...]:
    """Names of the phases: changes of contact, blackout, fast motion, start, and the groups of the covariates."""
    groups = [g for name, c in task.covariates.items() if name != "contact" for g in c.group_names(name)]
    if "contact" in task.covariates:
        last = ("steady contact", "free motion")
        return ("contact made", "contact lost", "blackout", "fast motion", "start", *groups, *last)
    return ("blackout", "fast motion", "start", *groups, OTHER)


@dataclass(frozen=True)
class Score:
    """A score of steps.

    Attributes:
        title: display name.
        unit: of the values. display: unit for display, and its factor.
        values: trace -> (T,), higher is worse.
        why_not: trace -> reason why the score does not apply, or None.
    """

    title: str
    unit: str
    display: tuple[str, float]
    values: Callable[[Trace], Array]
    why_not: Callable[[Trace], str | None] = lambda trace: None


@dataclass(frozen=True)
class Survey:
    """S steps of all episodes, concatenated in the order of their indices; SI units.

    Attributes:
        task, filter, checkpoint_hash, faults, seed, particles: of the traces; particles is None without particles.
        layers: L names: the K modalities, then ``fused``.
        angles: names of the A components in rad.
        episode, step: (S,) indices in the data set and in the episode.
        position: (S,) ``Episode.positions``.
        time: (S,) s since the first step of the episode, NaN without timestamps; None if no episode has any.
        scores: name -> (S,), for available scores; NaN at steps without a score.
        refused: name -> reason, for scores that do not apply.
        error: (S, L) main error (``Task.main_error``), in the unit of its components.
        angle_error: (S, L, A) rad.
        nees: (S, L) NEES / n.
        ess: (S,) effective sample size, or None.
        beta, effective_weights: (S, K) weights, averaged over map components, or None.
        phases: name (``phases_of``) -> (S,) mask, by priority: a step belongs to the first that applies. The groups of
            covariates are in the order of their size, the smallest first, without those of all steps.
    """

    task: Task
    filter: str
    checkpoint_hash: str
    faults: str
    seed: int
    particles: int | None
    layers: tuple[str, ...]
    angles: tuple[str, ...]
    episode: NDArray[np.int_]
    step: NDArray[np.int_]
    position: Array
    time: Array | None
    scores: dict[str, Array]
    refused: dict[str, str]
    error: Array
    angle_error: Array
    nees: Array
    ess: Array | None
    beta: Array | None
    effective_weights: Array | None
    phases: dict[str, Mask]

    @classmethod
    def from_episodes(cls, episodes: Iterable[EpisodeScores]) -> Survey:
        """Concatenate episodes in any order.

        Raises BadInput without episodes, and for those of different filters, faults or seeds.
        """
        by_index: dict[int, EpisodeScores] = {}
        for episode in episodes:
            by_index.setdefault(episode.index, episode)
            if by_index[episode.index] is not episode:
                raise BadInput(f"two traces of episode {episode.index}")
            _check_same_run(next(iter(by_index.values())).run, episode.run)
        if not by_index:
            raise BadInput("the failure search needs at least one trace")
        parts = [by_index[index].columns for index in sorted(by_index)]
        columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        run: dict[str, Any] = {**next(iter(by_index.values())).run, **{name: columns.get(name) for name in COLUMNS}}
        task = run["task"]
        return cls(
            **run,
            angles=tuple(c.name for c in task.components if c.unit == "rad"),
            scores={name: columns[f"score {name}"] for name in scores_of(task) if f"score {name}" in columns},
            phases=_phases(columns, task),
            time=None if np.isnan(columns["time"]).all() else columns["time"],
        )

    def time_of(self, index: int) -> float | None:
        """s from the first step of its episode to one of the S steps; None without timestamps."""
        return None if self.time is None or np.isnan(self.time[index]) else float(self.time[index])

    @property
    def phase_index(self) -> NDArray[np.int_]:
        """(S,) index in ``phases`` of the phase of each step."""
        return np.argmax(np.stack([*self.phases.values()]), axis=0)


@dataclass(frozen=True)
class EpisodeScores:
    """The part of a survey that one trace gives.

    Attributes:
        index: of the episode. run: attributes of the survey that are the same for all its episodes.
        columns: name -> (T, ...).
    """

    index: int
    run: Mapping[str, Any]
    columns: Mapping[str, NDArray[Any]]

    @classmethod
    def from_trace(cls, trace: Trace) -> EpisodeScores:
        run = {
            "task": trace.task,
            "filter": trace.filter,
            "checkpoint_hash": trace.checkpoint_hash,
            "faults": str(trace.faults),
            "seed": trace.seed,
            "particles": trace.particle_count,
            "layers": measures.layers(trace),
            "refused": {name: why for name, score in scores_of(trace.task).items() if (why := score.why_not(trace))},
        }
        return cls(trace.episode_index, run, _columns(trace))


def scores_of(task: Task) -> dict[str, Score]:
    """Scores of a task by name, including one for each angle."""
    main = task.main_error
    unit, display = task.components[main.indices[0]].unit, main.conversion
    angles = {c.name: _angle(i, c) for i, c in enumerate(task.components) if c.unit == "rad" and (i,) != main.indices}
    return {
        "error": Score(f"{main.name} error", unit, display, lambda trace: measures.main_error(trace)[:, -1]),
        **angles,
        "nees": Score("NEES/n", "", ("", 1.0), lambda trace: measures.nees(trace)[:, -1], _no_covariance),
        "ess": Score("particles / effective sample size", "x", ("x", 1.0), _degeneracy, _no_particles),
        "disagreement": Score("disagreement of modalities", "sigma", ("sigma", 1.0), disagreement, _no_fusion),
        "regret": Score("regret of the weights", unit, display, _regret, _no_fusion),
    }


def disagreement(trace: Trace) -> Array:
    """(T,): maximum of ``sqrt(d^T (S_i + S_j)^-1 d / n)`` over pairs of single-modality updates with difference d.

    1 if the difference matches the covariances. Because they share a prediction, a consistent filter has lower values.
    """
    mean, covariance = measures.means(trace)[:, :-1], measures.covariances(trace)[:, :-1]
    i, j = np.array(list(combinations(range(len(trace.modalities)), 2))).T
    difference = trace.task.difference(mean[:, i], mean[:, j])
    white = np.linalg.solve(covariance[:, i] + covariance[:, j], difference[..., None])[..., 0]
    return np.sqrt((difference * white).sum(-1) / difference.shape[-1]).max(axis=1)


def _angle(index: int, component: Component) -> Score:
    title, display = f"{component.label} error", component.conversion
    return Score(title, "rad", display, lambda trace: np.abs(measures.errors(trace)[:, -1, index]))


def _degeneracy(trace: Trace) -> Array:
    assert trace.particle_count is not None
    assert trace.effective_sample_size is not None
    return trace.particle_count / trace.effective_sample_size.astype(np.float64)


def _regret(trace: Trace) -> Array:
    """NaN in the warm-up: the belief starts at the truth, so the oracle's error is zero there with any weights."""
    return np.where(measures.counted(trace), main_regret(trace), np.nan)


def _no_covariance(trace: Trace) -> str | None:
    return None if (reason := measures.no_covariance(trace)) is None else f"this filter {reason}"


def _no_particles(trace: Trace) -> str | None:
    return None if trace.log_weights is not None else "this filter has no particles"


def _no_fusion(trace: Trace) -> str | None:
    return None if trace.effective_weights is not None else "this filter does not fuse several modalities"


def _check_same_run(first: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    for field in ("checkpoint_hash", "faults", "seed"):
        a, b = str(first[field]), str(other[field])
        if a != b:
            raise BadInput(f"traces differ in {field}, {a!r} and {b!r}; the failure search needs traces of one run")


def _columns(trace: Trace) -> dict[str, NDArray[Any]]:
    """(T, ...) columns of a trace in a survey; speeds in m/s and rad/s."""
    task, steps = trace.task, np.arange(len(trace))
    angles = list(task.angles)
    scores = {f"score {name}": s.values(trace) for name, s in scores_of(task).items() if s.why_not(trace) is None}
    episode = trace.episode
    recent = max(1, round(RECENT / episode.dt))
    contact = episode.contact.astype(bool)
    columns: dict[str, NDArray[Any]] = {
        **scores,
        "episode": np.full(len(trace), trace.episode_index),
        "step": steps,
        "position": episode.positions,
        "time": np.full(len(trace), np.nan) if episode.time is None else episode.time,
        "error": measures.main_error(trace),
        "angle_error": np.abs(measures.errors(trace)[..., angles]),
        "nees": measures.nees(trace),
        "contact": contact,
        "made": _recently(contact[1:] & ~contact[:-1], episode.positions, recent),
        "lost": _recently(~contact[1:] & contact[:-1], episode.positions, recent),
        "blackout": measures.blackout(trace),
        "start": steps < task.warmup,
        "speed": _speeds(trace, task),
    }
    for name, covariate in task.covariates.items():
        if name != "contact":
            masks = covariate.masks(name, episode.group_values(name))
            columns |= {f"{GROUP}{group}": mask for group, mask in masks}
    if trace.effective_sample_size is not None:
        columns["ess"] = trace.effective_sample_size
    where = list(task.map_indices)
    for name, weights in (("beta", trace.weights), ("effective_weights", trace.effective_weights)):
        if weights is not None:
            columns[name] = (weights[..., where] if weights.shape[-1] > 1 else weights).mean(-1)
    return columns


def _recently(events: Mask, position: NDArray[Any], steps: int) -> Mask:
    """(T,): whether there was an event in the last ``steps`` steps, including this one.

    Args:
        events: (T - 1,) from step 1. position: (T,) ``Episode.positions``.
    """
    latest = np.maximum.accumulate(np.where(np.concatenate([[False], events]), position, -np.inf))
    return np.asarray(position - latest < steps - ROUNDING)


def _speeds(trace: Trace, task: Task) -> Array:
    """(T, Q) speeds: object position, object rotation, and observed end effector."""
    states = trace.episode.states
    motion = task.difference(states, np.concatenate([states[:1], states[:-1]]))
    changes = [motion[:, list(task.map_indices)]]
    changes += [motion[:, [i]] for i in task.angles]
    effector = trace.episode.observations.get("effector_position")
    if effector is not None:
        changes.append(np.diff(effector, axis=0, prepend=effector[:1]))
    return np.stack([np.linalg.norm(change, axis=-1) for change in changes], axis=-1) / trace.episode.durations[:, None]


def _phases(columns: dict[str, NDArray[Any]], task: Task) -> dict[str, Mask]:
    contact = columns["contact"].astype(bool)
    fast = (columns["speed"] > np.quantile(columns["speed"], FAST, axis=0)).any(axis=-1)
    names = {"made": "contact made", "lost": "contact lost", "blackout": "blackout", "start": "start"}
    masks = {name: columns[key].astype(bool) for key, name in names.items()}
    masks |= {"fast motion": fast, "steady contact": contact, "free motion": ~contact, OTHER: np.ones_like(contact)}
    groups = {name.removeprefix(GROUP): mask.astype(bool) for name, mask in columns.items() if name.startswith(GROUP)}
    smallest = iter(sorted(groups, key=lambda name: int(groups[name].sum())))
    # A group of all steps, such as of a sensor without outages, would be the phase of all other steps.
    order = [next(smallest) if name in groups else name for name in phases_of(task)]
    return {name: {**masks, **groups}[name] for name in order if name not in groups or not groups[name].all()}

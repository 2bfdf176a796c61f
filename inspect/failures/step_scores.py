"""Every step of a data set: how bad it was, by several scores, and what was happening. Failures are found in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.filters.evaluate import LEFT_OUT
from beliefscope.inspect.diagnostics.weight_audit import position_regret
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array, Mask
from beliefscope.inspect.trace import Trace

RECENT = 0.5
"""s: what happened that short a time ago still counts as happening."""

FAST = 0.95
"""A speed above this quantile of the data set's is fast motion."""

GROUPS = ("contact made", "contact lost", "blackout", "fast motion", "start", "steady contact", "free")
"""What may be happening at a step, the most telling first: a step belongs to the first that holds."""


@dataclass(frozen=True)
class Score:
    """A way to be wrong. ``of``: trace -> (T,), higher is worse, in ``unit``. ``why_not``: why a trace has none."""

    title: str
    unit: str
    of: Callable[[Trace], Array]
    why_not: Callable[[Trace], str | None] = lambda trace: None


@dataclass(frozen=True)
class Survey:
    """S steps of all episodes, end to end in the order of the episodes' indices; SI units.

    Attributes:
        task, filter, checkpoint_hash, faults, seed, particles: what was traced. particles: None where there are none.
        layers: the K modalities, then ``fused``: L. angles: names of the A components in rad.
        episode, step: (S,) of the data set, and of the episode.
        scores: name -> (S,), for those that the filter has. refused: name -> why it has not.
        error: (S, L) m, distance from the truth on the map. angle_error: (S, L, A) rad. nees: (S, L).
        ess: (S,) effective sample size. beta, acting: (S, K), in the mean over the map's components where each has its
            own. None where the filter has none.
        happening: each of ``GROUPS`` -> (S,); several may hold at a step.
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
    scores: dict[str, Array]
    refused: dict[str, str]
    error: Array
    angle_error: Array
    nees: Array
    ess: Array | None
    beta: Array | None
    acting: Array | None
    happening: dict[str, Mask]

    @classmethod
    def of(cls, traces: Iterable[Trace]) -> Survey:
        """Takes what it needs of each trace and lets go of it. Their order does not matter.

        Raises BadInput where there is none, or they are of several filters, faults or seeds.
        """
        found: dict[int, dict[str, NDArray[Any]]] = {}
        one: Trace | None = None
        for trace in traces:
            one = trace if one is None else one
            _check_alike(one, trace)
            if trace.episode_index in found:
                raise BadInput(f"two traces are of episode {trace.episode_index}")
            found[trace.episode_index] = _columns(trace)
        if one is None:
            raise BadInput("failures are looked for in at least one trace")
        episodes = [found[index] for index in sorted(found)]
        columns = {key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]}
        task = measures.task_of(one)
        known = scores_of(task)
        return cls(
            task=task,
            filter=one.filter,
            checkpoint_hash=one.checkpoint_hash,
            faults=str(one.faults),
            seed=one.seed,
            particles=None if one.particles is None else one.particles.shape[1],
            layers=measures.layers(one),
            angles=tuple(c.name for c in task.components if c.unit == "rad"),
            scores={name: columns[f"score {name}"] for name in known if f"score {name}" in columns},
            refused={name: why for name, score in known.items() if (why := score.why_not(one))},
            happening=_happening(columns),
            episode=columns["episode"],
            step=columns["step"],
            error=columns["error"],
            angle_error=columns["angle_error"],
            nees=columns["nees"],
            ess=columns.get("ess"),
            beta=columns.get("beta"),
            acting=columns.get("acting"),
        )

    @property
    def group(self) -> NDArray[np.int_]:
        """(S,) int: which of ``GROUPS`` a step belongs to."""
        return np.argmax(np.stack([self.happening[name] for name in GROUPS]), axis=0)


def scores_of(task: Task) -> dict[str, Score]:
    """The scores of a task's filters by name: one for each of its angles is among them."""
    of_angles = {c.name: _angle(task.index(c.name), c.name) for c in task.components if c.unit == "rad"}
    return {"error": SCORES["error"], **of_angles, **SCORES}


def disagreement(trace: Trace) -> Array:
    """(T,): the largest ``sqrt(d^T (S_i + S_j)^-1 d / n)`` over pairs of modalities, d between their own posteriors.

    1 where they lie as far apart as their covariances say. They share a prediction, so a consistent filter has less.
    """
    mean, covariance = measures.means(trace)[:, :-1], measures.covariances(trace)[:, :-1]
    i, j = np.array(list(combinations(range(len(trace.modalities)), 2))).T
    apart = measures.wrapped(measures.task_of(trace), mean[:, i] - mean[:, j])
    white = np.linalg.solve(covariance[:, i] + covariance[:, j], apart[..., None])[..., 0]
    return np.sqrt((apart * white).sum(-1) / apart.shape[-1]).max(axis=1)


def _angle(index: int, name: str) -> Score:
    return Score(f"{name.replace('_', ' ')} error", "rad", lambda trace: np.abs(measures.errors(trace)[:, -1, index]))


def _collapse(trace: Trace) -> Array:
    assert trace.particles is not None
    assert trace.effective_sample_size is not None
    return trace.particles.shape[1] / trace.effective_sample_size.astype(np.float64)


def _no_covariance(trace: Trace) -> str | None:
    return None if trace.has_covariance else "this filter claims no covariance"


def _no_particles(trace: Trace) -> str | None:
    return None if trace.log_weights is not None else "this filter has no particles"


def _no_fusion(trace: Trace) -> str | None:
    return None if trace.acting is not None else "this filter does not fuse several modalities"


SCORES: dict[str, Score] = {
    "error": Score("position error", "m", lambda trace: measures.position_error(trace)[:, -1]),
    "nees": Score("NEES", "", lambda trace: measures.nees(trace)[:, -1], _no_covariance),
    "ess": Score("particles to effective ones", "x", _collapse, _no_particles),
    "disagreement": Score("modalities apart", "sigma", disagreement, _no_fusion),
    "regret": Score("regret of the weights", "m", position_regret, _no_fusion),
}
"""By name; those of the task's angles come after ``error``."""


def _check_alike(first: Trace, other: Trace) -> None:
    for what in ("checkpoint_hash", "faults", "seed"):
        a, b = str(getattr(first, what)), str(getattr(other, what))
        if a != b:
            raise BadInput(f"traces of {what} {a!r} and {b!r}: failures are looked for in those of one run")


def _columns(trace: Trace) -> dict[str, NDArray[Any]]:
    """(T, ...) of all that a survey keeps of a trace. Speeds are in m/s and rad/s."""
    task, steps = measures.task_of(trace), np.arange(len(trace))
    angles = [i for i, c in enumerate(task.components) if c.unit == "rad"]
    scores = {f"score {name}": s.of(trace) for name, s in scores_of(task).items() if s.why_not(trace) is None}
    recent = max(1, round(RECENT / trace.episode.dt))
    contact = trace.episode.contact.astype(bool)
    columns: dict[str, NDArray[Any]] = {
        **scores,
        "episode": np.full(len(trace), trace.episode_index),
        "step": steps,
        "error": measures.position_error(trace),
        "angle_error": np.abs(measures.errors(trace)[..., angles]),
        "nees": measures.nees(trace),
        "contact": contact,
        "made": _recently(contact[1:] & ~contact[:-1], recent),
        "lost": _recently(~contact[1:] & contact[:-1], recent),
        "blackout": measures.blackout(trace),
        "start": steps < LEFT_OUT,
        "speed": _speeds(trace, task),
    }
    if trace.effective_sample_size is not None:
        columns["ess"] = trace.effective_sample_size
    where = list(task.map_indices)
    for name, weights in (("beta", trace.weights), ("acting", trace.acting)):
        if weights is not None:
            columns[name] = (weights[..., where] if weights.shape[-1] > 1 else weights).mean(-1)
    return columns


def _recently(events: Mask, steps: int) -> Mask:
    """(T,): whether one of the last ``steps`` steps, this one too, had an event; events (T - 1,) are of step 1 on."""
    count = np.concatenate([np.zeros(steps + 1, int), np.cumsum(events)])
    return count[steps:] > count[:-steps]


def _speeds(trace: Trace, task: Task) -> Array:
    """(T, Q): how fast the object moves on the map, how fast it turns, and how fast the end effector says it moves."""
    moved = measures.wrapped(task, np.diff(trace.episode.states, axis=0, prepend=trace.episode.states[:1]))
    changes = [moved[:, list(task.map_indices)]]
    changes += [moved[:, [i]] for i, c in enumerate(task.components) if c.unit == "rad"]
    hand = trace.episode.observations.get("effector_position")
    if hand is not None:
        changes.append(np.diff(hand, axis=0, prepend=hand[:1]))
    return np.stack([np.linalg.norm(change, axis=-1) for change in changes], axis=-1) / trace.episode.dt


def _happening(columns: dict[str, NDArray[Any]]) -> dict[str, Mask]:
    contact = columns["contact"].astype(bool)
    fast = (columns["speed"] > np.quantile(columns["speed"], FAST, axis=0)).any(axis=-1)
    named = {"made": "contact made", "lost": "contact lost", "blackout": "blackout", "start": "start"}
    happening = {name: columns[key].astype(bool) for key, name in named.items()}
    return {**happening, "fast motion": fast, "steady contact": contact, "free": ~contact}

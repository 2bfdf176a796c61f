"""Smallest repair of a failure: fewest sensors and shortest interval whose repair keeps the error below a bound.

A repair drops measurement models over an interval, or restores modalities from a clean episode. Candidates are replayed
in batches from the belief before their first step, with the random numbers of the original run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import MainError, display_name
from beliefscope.datasets.text import plural
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.models.common_random_numbers import Common
from beliefscope.filters.subsets import input_modalities
from beliefscope.inspect.statistics.measures import Array, main_error, wrapped
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.replay import Replay, repeat_belief

MAX_REPLAYS = 60
"""Maximum number of replays of a search."""

PROBES = 4
"""Candidates of one batch while an end of the interval moves."""

LEADS = (0, 3, 8, 20)
"""Numbers of steps before a failure from which sensors are dropped."""

SHRUNK = 2
"""Number of repairs whose interval is shortened."""


@dataclass(frozen=True)
class Candidate:
    """Steps ``first`` to ``to - 1``; ``sensors`` are dropped or, if ``restored``, taken from a clean episode."""

    sensors: tuple[str, ...]
    restored: bool
    first: int
    to: int

    @property
    def steps(self) -> int:
        return self.to - self.first

    def __str__(self) -> str:
        names = " and ".join(map(display_name, self.sensors))
        verb = "restoring" if self.restored else "dropping"
        return f"{verb} {names} from step {self.first} to {self.to - 1}"


@dataclass(frozen=True)
class Repair:
    """Result of ``smallest_repair``.

    Attributes:
        failure: first and last step of the failure. bound: in the unit of the main error's components.
        error: RMS main error over the failure. repaired: the same with the repair; NaN without any.
        candidate: the repair; None if no candidate keeps the error below the bound.
        replays: number of replays.
    """

    failure: tuple[int, int]
    bound: float
    error: float
    repaired: float
    candidate: Candidate | None
    replays: int
    main: MainError

    @property
    def sentence(self) -> str:
        """The repair and its effect."""
        first, last = self.failure
        failure = f"The error of {self.main.text(self.error)} in steps {first} to {last}"
        if self.candidate is None:
            return f"{failure} is not repaired by any sensor: check the dynamics and the weights."
        effect = f"becomes {self.main.text(self.repaired)} (bound {self.main.text(self.bound)})"
        return f"{failure} {effect} by {self.candidate}, {plural(self.candidate.steps, 'step')}."

    def to_json(self) -> dict[str, Any]:
        """JSON values; ``repair`` is null if there is none."""
        c = self.candidate
        repair = (
            None if c is None else {"sensors": list(c.sensors), "restored": c.restored, "steps": [c.first, c.to - 1]}
        )
        numbers = {"bound": self.bound, "error": self.error, "repaired": None if c is None else self.repaired}
        return {"failure": list(self.failure), **numbers, "repair": repair, "replays": self.replays}


class Candidates:
    """Replays of a run with candidates, and how many there were."""

    @torch.no_grad()
    def __init__(self, checkpoint: Checkpoint, trace: Trace, failure: tuple[int, int], clean: Episode | None) -> None:
        self.filter, self.trace, self.failure = checkpoint.filter, trace, failure
        self.replay = Replay(checkpoint, trace)
        self.replays = 0
        self.modalities = input_modalities(self.filter)
        self.restored = {} if clean is None else self._restored(clean)

    def longest(self, count: int) -> list[Candidate]:
        """Candidates with ``count`` sensors up to the failure's end. At least one sensor remains.

        Those with restored sensors start at step 0. Without a sensor the error grows with time, so those with dropped
        sensors start at several steps before the failure (``LEADS``) and end with it or in its middle.
        """
        first, end = self.failure[0], self.failure[1] + 1
        models = self.filter.names
        dropped = combinations(models, count) if count < len(models) else ()
        spans = sorted({(max(0, first - lead), to) for lead in LEADS for to in (end, (first + end + 1) // 2)})
        restored = [Candidate(names, True, 0, end) for names in self.restored if len(names) == count]
        return [Candidate(names, False, *span) for names in dropped for span in spans] + restored

    @torch.no_grad()
    def errors(self, candidates: Sequence[Candidate]) -> Array:
        """(N,) m: RMS position error over the failure of the run with each candidate."""
        if not candidates:
            return np.zeros(0)
        self.replays += len(candidates)
        start, end = min(c.first for c in candidates), self.failure[1] + 1
        belief = repeat_belief(self.replay.beliefs[start], len(candidates))
        evidence, generator = self._evidence(candidates)[start:end], self.replay.generator(start, Common)
        means = [step.estimate.mean for _, step in self.filter.steps(belief, evidence, generator)]
        estimates = self.filter.statistics.state_to_si(torch.stack(means)).numpy()  # (t, N, n)
        difference = wrapped(self.trace.task, estimates - self.trace.episode.states[start:end, None])
        squared = np.square(self.trace.task.main_error.norm(difference))
        unchanged = main_error(self.trace)[self.failure[0] : max(start, self.failure[0]), -1]
        total = np.square(unchanged).sum() + squared[max(0, self.failure[0] - start) :].sum(0)
        return np.asarray(np.sqrt(total / (self.failure[1] + 1 - self.failure[0])))

    def _restored(self, clean: Episode) -> dict[tuple[str, ...], Evidence]:
        """Modalities -> evidence of the run with these of a clean episode; the controls too if all are restored."""
        task, episode = self.filter.task, self.trace.episode
        result = {}
        for count in range(1, len(self.modalities) + 1):
            for names in combinations(self.modalities, count):
                keys = [key for name in names for key in task.modalities[name]]
                observations = {**episode.observations, **{key: clean.observations[key] for key in keys}}
                controls = clean.controls if count == len(self.modalities) else episode.controls
                restored = replace(episode, observations=observations, controls=controls)
                result[names] = self.filter.encode(Steps.from_episodes(task, [restored]).episode(0))
        return result

    def _evidence(self, candidates: Sequence[Candidate]) -> Evidence:
        """(T, N, ...) evidence of the run with each candidate."""
        original, steps = self.replay.evidence, torch.arange(len(self.replay.evidence))
        at = torch.stack([(steps >= c.first) & (steps < c.to) for c in candidates], dim=1)  # (T, N)
        sources = [self.restored[c.sensors] if c.restored else original for c in candidates]

        def mixed(name: str) -> Tensor | None:
            if (values := getattr(original, name)) is None:
                return None
            other = torch.cat([getattr(source, name) for source in sources], dim=1)
            return torch.where(at.reshape(*at.shape, *(1,) * (values.ndim - 2)), other, values)

        names = self.filter.names
        kept = torch.tensor([[c.restored or name not in c.sensors for name in names] for c in candidates])
        present = kept | ~at[..., None]  # (T, N, K)
        if original.present is not None:
            present = present & original.present
        fields: dict[str, Any] = {name: mixed(name) for name in ("control", "observation", "noise", "log_weights")}
        evidence = Evidence(**fields)
        return evidence if present.all() else evidence.select_models(present)


def check_repairable(checkpoint: Checkpoint) -> None:
    """Raise BadInput for an external filter, whose steps cannot be replayed without a sensor."""
    if isinstance(checkpoint, ExternalFilter):
        raise BadInput(f"external filter {checkpoint.name!r} has no smallest repair: its sensors cannot be dropped")


def smallest_repair(
    checkpoint: Checkpoint, trace: Trace, bound: float, clean: Episode | None = None, max_replays: int = MAX_REPLAYS
) -> Repair | None:
    """Smallest repair of the largest failure of a run; None if no error of a counted step exceeds the bound.

    The failure is the stretch of steps around the largest position error in which it exceeds ``bound`` (m). A repair
    keeps the RMS error of the failure below it. Of the repairs with the fewest sensors it is the shortest found: each
    end of the interval moves as far as possible (delta debugging with several candidates at a time), then shorter
    intervals are tried elsewhere. Neither its first nor its last step can be left out.

    Args:
        clean: the episode without sensor faults; modalities can be restored from it.

    Raises BadInput for a trace of another checkpoint, for an external filter, and for one without single sensors to
    repair.
    """
    check_repairable(checkpoint)
    failure = largest_failure(trace, bound)
    if failure is None:
        return None
    search = Candidates(checkpoint, trace, failure, clean)
    if len(search.filter.names) < 2 and clean is None:
        raise BadInput(f"filter {checkpoint.name!r} has only one measurement model: dropping it leaves no measurement")
    error = float(np.sqrt(np.square(main_error(trace)[failure[0] : failure[1] + 1, -1]).mean()))
    for count in range(1, len(search.modalities) + 1):
        candidates = search.longest(count)
        errors = search.errors(candidates)
        passing = sorted((e, i) for i, e in enumerate(errors.tolist()) if e <= bound)[:SHRUNK]
        shortened = [_shorten(search, candidates[i], bound, max_replays) for _, i in passing]
        if shortened:
            best = min(shortened, key=lambda candidate: candidate.steps)
            best = _elsewhere(search, best, bound, max_replays)
            repaired = float(search.errors([best])[0])
            return Repair(failure, bound, error, repaired, best, search.replays, trace.task.main_error)
    return Repair(failure, bound, error, np.nan, None, search.replays, trace.task.main_error)


def largest_failure(trace: Trace, bound: float) -> tuple[int, int] | None:
    """First and last step of the stretch with errors above the bound (m) around the largest one of a counted step."""
    error = main_error(trace)[:, -1]
    first = trace.task.first_counted(len(trace))
    peak = first + int(np.argmax(error[first:]))
    if not error[peak] > bound:
        return None
    below = np.flatnonzero(error <= bound)
    begin, end = below[below < peak], below[below > peak]
    return max(first, int(begin[-1]) + 1 if len(begin) else 0), int(end[0]) - 1 if len(end) else len(error) - 1


def _shorten(search: Candidates, candidate: Candidate, bound: float, max_replays: int) -> Candidate:
    """Move first its start, then its end inwards while it repairs."""
    starts = _move(
        search, lambda step: replace(candidate, first=step), candidate.first, candidate.to, bound, max_replays
    )
    candidate = replace(candidate, first=starts)
    ends = _move(search, lambda step: replace(candidate, to=step), candidate.to, candidate.first, bound, max_replays)
    return replace(candidate, to=ends)


def _move(
    search: Candidates, at: Callable[[int], Candidate], good: int, bad: int, bound: float, max_replays: int
) -> int:
    """The step nearest to ``bad`` at which a candidate repairs, by sections with ``PROBES`` candidates at a time."""
    while abs(bad - good) > 1 and search.replays + PROBES < max_replays:
        probes = np.unique(np.rint(np.linspace(good, bad, PROBES + 2)[1:-1]).astype(int)).tolist()
        probes = [probe for probe in probes if probe not in (good, bad)]
        errors = search.errors([at(probe) for probe in probes])
        passing = [probe for probe, error in zip(probes, errors, strict=True) if error <= bound]
        best = min(passing, key=lambda probe: abs(probe - bad), default=good)
        between = [probe for probe in probes if (probe - best) * (bad - best) > 0]
        good, bad = best, min(between, key=lambda probe: abs(probe - best), default=bad)
    return good


def _elsewhere(search: Candidates, candidate: Candidate, bound: float, max_replays: int) -> Candidate:
    """Shorter repairs with other first steps, as many as the number of replays allows; the last is for the result."""
    end = search.failure[1] + 1
    while candidate.steps > 1 and (room := min(2 * PROBES, max_replays - search.replays - 1)) > 0:
        steps = candidate.steps - 1
        near = np.arange(candidate.first - room // 2 + 1, candidate.first + room - room // 2 + 1)
        starts = near[(near >= 0) & (near + steps <= end)].tolist()
        moved = [replace(candidate, first=start, to=start + steps) for start in starts]
        passing = [c for c, e in zip(moved, search.errors(moved), strict=True) if e <= bound]
        if not passing:
            break
        candidate = passing[0]
    return candidate


def healthy_bound(statistics: Mapping[str, Array]) -> float:
    """m: twice the 95 % quantile of the RMS position error of healthy episodes; raises BadInput if it is unknown."""
    if (errors := statistics.get("error//all")) is None:
        raise BadInput("the healthy record has no position errors; give a bound")
    return 2.0 * float(np.nanquantile(errors, 0.95))

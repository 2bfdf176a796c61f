"""Survey: runs a filter over the episodes of a data set and scores every step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Engine, Progress, run_blocks
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.failures.step_scores import EpisodeScores, Score, Survey, scores_of
from beliefscope.inspect.traces.batch import Episodes, trace_all

BLOCK = 16
"""Episodes that a process runs at a time."""


def held_out_or_all(data: Episodes) -> Iterable[int]:
    """Indices of the held-out episodes of a data set, or of all episodes that are given without one."""
    if isinstance(data, Dataset):
        return data.held_out()
    return data if isinstance(data, Mapping) else range(len(data))


@dataclass(frozen=True)
class ScoredRuns(Diagnostic):
    """A result by one score over runs of a filter.

    Attributes:
        task, filter, checkpoint_hash, faults, seed, particles: of the runs.
        by: name of the score.
        title, unit: display name and unit of the score: of a component, sigma, x (ratio) or none.
        conversion: unit for display of the score, and its factor.
    """

    task: str
    filter: str
    checkpoint_hash: str
    faults: str
    seed: int
    particles: int | None
    by: str
    title: str
    unit: str
    conversion: tuple[str, float]


def fields_of_runs(survey: Survey, by: str) -> dict[str, Any]:
    """The fields of ``ScoredRuns``. Raises BadInput for an unknown score, and for one that does not apply."""
    score = find_score(by, survey.task)
    check_applies(by, survey.refused.get(by))
    runs = {name: getattr(survey, name) for name in ("filter", "checkpoint_hash", "faults", "seed", "particles")}
    by_score = {"by": by, "title": score.title, "unit": score.unit, "conversion": score.display}
    return {"task": survey.task.name, **runs, **by_score}


def survey_of(
    checkpoint: Checkpoint,
    data: Episodes,
    episodes: Iterable[int],
    *,
    by: str | None = None,
    faults: Faults = NO_FAULTS,
    seed: int = 0,
    particles: int = 300,
    engine: Engine = "local",
    workers: int = 1,
    progress: Progress = None,
) -> Survey:
    """Run a filter over episodes of a data set, many at once.

    Args:
        by: a score that must apply to the filter.
        engine, workers: where to run, as for ``filters.engine.run_blocks``. The values do not depend on them.

    Raises BadInput after the first episodes if ``by`` does not apply, as ``trace``, and for several workers with an
    external filter that has no build function.
    """
    indices = list(episodes)
    longest = data.most_steps(indices) if isinstance(data, Dataset) else max((len(data[i]) for i in indices), default=0)
    faults.check(checkpoint.task, longest)
    settings: dict[str, Any] = {"faults": faults, "seed": seed, "particles": particles}
    blocks = [indices[i : i + BLOCK] for i in range(0, len(indices), BLOCK)]
    scores: list[EpisodeScores] = []
    for _, finished in run_blocks(partial(_scores, checkpoint, data, settings), blocks, engine, workers, progress):
        if by is not None and finished:
            check_applies(by, finished[0].run["refused"].get(by))
        scores += finished
    return Survey.from_episodes(scores)


def _scores(
    checkpoint: Checkpoint,
    data: Episodes,
    settings: Mapping[str, Any],
    indices: Sequence[int],
    progress: Progress,
) -> list[EpisodeScores]:
    runs = trace_all(checkpoint, data, indices, **settings, progress=progress)
    return [EpisodeScores.from_trace(run) for run in runs]


def find_score(by: str, task: Task) -> Score:
    """The named score. Raises BadInput for a name that is not a score of the task."""
    scores = scores_of(task)
    check_name(f"score of task {task.name!r}", by, scores)
    return scores[by]


def check_applies(by: str, reason: str | None) -> None:
    """Raise BadInput if there is a reason why the score does not apply."""
    if reason:
        raise BadInput(f"no score {by!r}: {reason}")

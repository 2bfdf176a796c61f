"""Survey: runs a filter over the episodes of a data set and scores every step."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.failures.step_scores import Score, Survey, scores_of
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.batch import trace_all


def survey_of(
    checkpoint: Checkpoint,
    data: Dataset | Mapping[int, Episode] | Sequence[Episode],
    episodes: Iterable[int],
    *,
    by: str | None = None,
    faults: Faults = NO_FAULTS,
    seed: int = 0,
    particles: int = 300,
    progress: Callable[[float], None] | None = None,
) -> Survey:
    """Run a filter over episodes of a data set, many at once.

    Particle filters and external filters run over one episode after the other: the random numbers are those of
    ``trace``.

    Args:
        by: a score that must apply to the filter.

    Raises BadInput after the first trace if ``by`` does not apply, and as ``trace``.
    """
    indices = list(episodes)
    settings: dict[str, Any] = {"faults": faults, "seed": seed, "particles": particles}
    return Survey.from_traces(traces_of(checkpoint, data, indices, by=by, progress=progress, **settings))


def traces_of(
    checkpoint: Checkpoint,
    data: Dataset | Mapping[int, Episode] | Sequence[Episode],
    indices: Sequence[int],
    *,
    by: str | None = None,
    progress: Callable[[float], None] | None = None,
    **settings: Any,
) -> Iterator[Trace]:
    """The traces of ``survey_of``, with the same arguments and errors."""

    def one_by_one() -> Iterator[Trace]:
        for done, index in enumerate(indices):
            share = _partial_progress(progress, done, len(indices))
            yield trace(checkpoint, data[index], index, **settings, progress=share)

    batched = checkpoint.kind not in ("pf", "external")
    for done, run in enumerate(trace_all(checkpoint, data, indices, **settings) if batched else one_by_one()):
        if not done and by is not None:
            check_applies(by, find_score(by, checkpoint.task).why_not(run))
        if batched and progress is not None:
            progress((done + 1) / len(indices))
        yield run


def find_score(by: str, task: Task) -> Score:
    """The named score. Raises BadInput for a name that is not a score of the task."""
    scores = scores_of(task)
    check_name(f"score of task {task.name!r}", by, scores)
    return scores[by]


def check_applies(by: str, reason: str | None) -> None:
    """Raise BadInput if there is a reason why the score does not apply."""
    if reason:
        raise BadInput(f"no failures by {by}: {reason}")


def _partial_progress(
    progress: Callable[[float], None] | None, done: int, count: int
) -> Callable[[float], None] | None:
    return None if progress is None else lambda share: progress((done + share) / count)

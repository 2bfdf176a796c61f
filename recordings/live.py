"""Records a filter while it runs: ``NAME.live``, which has every step, and beside it a ``NAME.rrd`` that Rerun opens.

The filter hands over what it knew and goes on. One thread puts that into arrays and into the ``.live`` file; another
follows that file, as any reader does, and draws its steps into the ``.rrd`` (``recordings.liveviews``). However slow
drawing is, neither the filter nor the data wait for it.
"""

from __future__ import annotations

import queue
import threading
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.batch import check_shapes
from beliefscope.filters.belief import Evidence, Gaussian, StepTrace
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.adapter import Values, checked, derived, named
from beliefscope.filters.external.load import model_names
from beliefscope.inspect.trace import Trace, assemble
from beliefscope.inspect.traces.foreign import with_unknown
from beliefscope.inspect.traces.live_file import SUFFIX, GrowingWriter
from beliefscope.recordings.rerun_log.live_views import LiveViews, write_live

FOLDER = Path("workspace/live")
WAITING = 1000
"""Steps that may wait for the disk; with 300 particles, 30 MB of them. The filter waits for one more."""

BLOCK = 100
"""Steps at most that are written at once, where several wait."""


@dataclass(frozen=True)
class _Row:
    """What one step hands over: NumPy arrays of its own, or what no filter changes any more."""

    known: StepTrace | Values
    observations: dict[str, NDArray[Any]]
    control: NDArray[Any]
    truth: NDArray[Any]
    contact: bool
    qpos: NDArray[Any]
    evidence: Evidence | None


class LiveRecorder:
    """Takes a running filter's steps; as a context, so that what was recorded is whole whatever ends the run.

        with LiveRecorder("run", checkpoint) as live:
            ...
            belief, known = filter.step(belief, evidence[t], generator)
            live.step(known, observations, control, evidence=evidence[t])

    or, for a filter of another kind, by the names of docs/own_filter.md (NumPy or torch, of this one step):

        with LiveRecorder("run", task="door") as live:
            ...
            live.step({"estimate_mean": mean, "estimate_covariance": covariance}, observations, control)

    ``step`` raises BadInput for what cannot be recorded only at the first step. From then on it never raises: what goes
    wrong is warned of once, and raised where the context ends.

    Attributes:
        path: of the ``.live`` file; its ``.rrd`` has the same name. Where the name was taken, with a number behind it.
        steps: taken. waited: of these, how many found WAITING others before them and had to wait for the disk.
        lost: steps that could not be kept, because the disk was full or their arrays were not as at the first.
    """

    def __init__(
        self,
        name: str,
        checkpoint: Checkpoint | None = None,
        *,
        task: str = "",
        modalities: Sequence[str] = (),
        folder: str | Path = FOLDER,
        start: Gaussian | None = None,
        like: Episode | None = None,
        expected: int | None = None,
        views: bool = True,
        **given: Any,
    ) -> None:
        """Writes nothing yet: files come with the first step.

        Args:
            checkpoint: of the filter, where it is one of this project's. task: of any other; its name or
                ``path/to/file.py:NAME``. modalities: names of the K measurement models, as in docs/own_filter.md.
            folder: made if missing. A page of ``beliefscope serve --workspace W`` shows those in ``W/live``.
            start: the belief before step 0, N = 1: of a checkpoint standardised as its ``start`` took it; of another
                filter in SI units. Without it: unknown, NaN.
            like: of which this is a run, where it is known: its dt, seed, split and provenance are those of the run.
            expected: how many steps there will be, for those who watch.
            views: whether there is to be an ``.rrd`` as well.
            given: fields of the trace that say where it comes from: filter, seed, faults, data_hash, settings, ...

        Raises:
            BadInput: neither a checkpoint nor a task, an unknown task, a name with a folder in it.
        """
        if checkpoint is None and not task:
            raise BadInput("a live run needs the filter's checkpoint, or the name of the task it is for")
        if Path(name).name != name or name.startswith("."):
            raise BadInput(f"live run {name!r}: a name without a folder is wanted; that is given by folder=")
        self._task = find_task(task) if checkpoint is None else checkpoint.task
        self._checkpoint, self._modalities, self._start, self._expected = checkpoint, modalities, start, expected
        self._given = {"settings": {"torch": torch.__version__}} | given
        self._about: dict[str, Any] = (
            {"dt": self._task.dt, "seed": -1, "split": "test", "provenance": {"live": True}}
            if like is None
            else {key: getattr(like, key) for key in ("dt", "seed", "split", "provenance")}
        )
        self.path = _free(Path(folder), name)
        self.steps = self.waited = self.lost = 0
        self._error: BadInput | None = None
        self._closed = False
        self._queue: queue.Queue[_Row | None] = queue.Queue(WAITING)
        self._keeping = threading.Thread(target=self._keep, name="live-data", daemon=True)
        self._views = LiveViews(self.path) if views else None
        self._writer: GrowingWriter | None = None
        self._sizes = {"n": len(self._task.components)}

    def step(
        self,
        known: StepTrace | Mapping[str, Any] | tuple[Any, Any] | ArrayLike,
        observations: Mapping[str, ArrayLike],
        control: ArrayLike | None = None,
        *,
        truth: ArrayLike | None = None,
        contact: bool | None = None,
        qpos: ArrayLike = (),
        evidence: Evidence | None = None,
    ) -> None:
        """Hands over one step, and returns. All arrays are copied, but those in a StepTrace and its evidence.

        Args:
            known: what the filter's ``step`` gave beside its belief; of another filter the mean, mean and covariance,
                or a dictionary. N is 1, or not there.
            observations: by the task's keys, as many as there are. control: (c,).
            truth: (n,) the true state, where something measures it; NaN else. contact: whether the robot truly touched
                the object; else what the observation ``contact`` says, where there is one.
            qpos: (nq,) joint positions for the replay of the task's simulation.
            evidence: of a StepTrace, what the filter's ``step`` was given.

        Raises BadInput at the first step only: for values that no trace has, and for a place that cannot be written.
        """
        seen = {key: np.array(value) for key, value in observations.items()}
        row = _Row(
            known if isinstance(known, StepTrace) else _with_n(named(_tensors(known), "the filter")),
            {key: value if value.dtype == np.uint8 else value.astype(np.float32) for key, value in seen.items()},
            np.array(np.zeros(self._task.control_size) if control is None else control, np.float32),
            np.array(np.full(self._sizes["n"], np.nan) if truth is None else truth, np.float32),
            bool(np.any(seen.get("contact", False))) if contact is None else contact,
            np.array(qpos, np.float32),
            evidence,
        )
        self.steps += 1
        if self._writer is None:
            self._begin(row)
        else:
            self.waited += int(self._queue.full())
            self._queue.put(row)

    @property
    def behind(self) -> int:
        """The most steps by which the drawing was ever behind the data."""
        return 0 if self._views is None else self._views.behind

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()
        if kind is None and self._error is not None:
            raise self._error

    def close(self) -> None:
        """Writes what still waits, ends the file, and replaces the ``.rrd`` by the one that ``record`` would write."""
        if self._writer is None or self._closed:
            return
        self._closed = True
        self._queue.put(None)
        self._keeping.join()
        if self._views is None:
            return
        self._views.close(draw_rest=self._error is not None)
        if self._error is None:
            try:
                write_live(self.path, self.path.with_suffix(".rrd"))
            except BadInput as error:
                self._error = error

    def _begin(self, row: _Row) -> None:
        """Makes the file with the first step, here and not later: what is wrong is wrong from the start."""
        if not isinstance(row.known, StepTrace):
            checked(row.known, (1,), self._sizes, "the filter")
        elif self._checkpoint is None or row.evidence is None:
            raise BadInput("a StepTrace is recorded with its filter's checkpoint and the step's evidence")
        first = self._part([row])
        if first.particles is not None:
            self._given["settings"] = {"particles": first.particles.shape[1]} | dict(self._given["settings"])
            first = replace(first, settings=self._given["settings"])
        known = {key: shape for key, shape in self._task.observations.items() if key in row.observations}
        check_shapes(replace(self._task, observations=known), first.episode, "the first step")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(f"cannot make folder {str(self.path.parent)!r}: {error.strerror}") from None
        self._writer = GrowingWriter(self.path, first, self._expected)
        self._writer.append(first)
        self._keeping.start()
        if self._views is not None:
            self._views.start()

    def _keep(self) -> None:
        """The thread of the data: what waits goes into the file, in larger blocks the more of it there is."""
        assert self._writer is not None
        going = True
        while going:
            rows = [self._queue.get()]
            while len(rows) < BLOCK and not self._queue.empty():
                rows.append(self._queue.get())
            going = rows[-1] is not None
            block = [row for row in rows if row is not None]
            if block and self._error is None:
                try:
                    self._writer.append(self._part(block))
                except BadInput as error:
                    self._fail(error)
                except Exception as error:
                    self._fail(BadInput(f"step {self._writer.steps}: {type(error).__name__}: {error}"))
            if self._error is not None:
                self.lost += len(block)
        if self._error is None:
            try:
                self._writer.finish()
            except BadInput as error:
                self._fail(error)
        self._writer.close()

    def _fail(self, error: BadInput) -> None:
        self._error = error
        warnings.warn(f"live run {str(self.path)!r} ends at step {self.steps}: {error}", stacklevel=2)

    def _part(self, rows: Sequence[_Row]) -> Trace:
        """Some steps as a trace: what a filter of ours knew, or what another one said."""
        episode = Episode(
            task=self._task.name,
            states=np.stack([row.truth for row in rows]),
            controls=np.stack([row.control for row in rows]),
            observations={key: np.stack([row.observations[key] for row in rows]) for key in rows[0].observations},
            contact=np.array([row.contact for row in rows]),
            qpos=np.stack([row.qpos for row in rows]),
            **self._about,
        )
        n = self._sizes["n"]
        unknown = Gaussian(torch.full((1, n), torch.nan), torch.full((1, n, n), torch.nan))
        start = unknown if self._start is None else self._start
        knew = [row.known for row in rows if isinstance(row.known, StepTrace)]
        evidence = [row.evidence for row in rows if row.evidence is not None]
        if self._checkpoint is not None and len(knew) == len(evidence) == len(rows):
            return assemble(self._checkpoint, episode, start, _joined(evidence), knew, **self._given)
        return self._foreign([row.known for row in rows if not isinstance(row.known, StepTrace)], episode, start)

    def _foreign(self, said: Sequence[Values], episode: Episode, start: Gaussian) -> Trace:
        """What a filter of another kind said at each step, as a trace; without what it said at some of them only."""
        n = self._sizes["n"]
        always = [name for name in said[0] if all(name in one for one in said)]
        values = derived({name: _typed(name, torch.cat([one[name] for one in said])) for name in always})
        modalities = model_names(values, 1, self._modalities, self._task)
        arrays = {name: np.ascontiguousarray(value.numpy()) for name, value in values.items()}
        about: dict[str, Any] = {"filter": "own"} | self._given | with_unknown(arrays, len(modalities))
        return Trace(
            episode=episode,
            modalities=modalities,
            kind="foreign",
            start_mean=start.mean.reshape(n).float().numpy(),
            start_covariance=start.covariance.reshape(n, n).float().numpy(),
            **about,
        )


def _free(folder: Path, name: str) -> Path:
    """The first of NAME, NAME-2, NAME-3, ... that no run has."""
    number, path = 1, folder / f"{name}{SUFFIX}"
    while path.exists():
        number += 1
        path = folder / f"{name}-{number}{SUFFIX}"
    return path


def _tensors(known: Any) -> Any:
    """NumPy's arrays and numbers as tensors, within a dictionary or a pair as well."""
    if isinstance(known, Mapping):
        return {name: _tensors(value) for name, value in known.items()}
    if isinstance(known, tuple):
        return tuple(map(_tensors, known))
    return known if isinstance(known, Tensor) else torch.from_numpy(np.array(known))


def _with_n(values: Values) -> Values:
    """With the axis N = 1 in front, where it was not there."""
    there = values["estimate_mean"].ndim > 1
    return values if there else {name: value[None] for name, value in values.items()}


def _typed(name: str, value: Tensor) -> Tensor:
    return value.int() if name == "ancestors" else value.float()


def _joined(evidence: Sequence[Evidence]) -> Evidence:
    """Of T steps, (N, ...) each, as (T, N, ...)."""
    every = {field.name: [getattr(one, field.name) for one in evidence] for field in fields(Evidence)}
    joined: dict[str, Any] = {name: torch.stack(values) for name, values in every.items() if values[0] is not None}
    return Evidence(**({"noise": None, "log_weights": None} | joined))

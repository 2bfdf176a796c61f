"""Records a running filter to ``NAME.live``, which has every step, and ``NAME.rrd``, which Rerun opens.

``LiveRecorder.step`` only queues a step. One thread converts queued steps to arrays and appends them to the ``.live``
file; another reads that file and writes the ``.rrd`` (``rerun_log.live_views``). A slow ``.rrd`` delays neither the
filter nor the ``.live`` file.
"""

from __future__ import annotations

import dataclasses
import queue
import threading
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode, time_error
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import check_shapes
from beliefscope.filters.belief import Evidence, Gaussian, StepTrace
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.adapter import (
    MEASUREMENTS,
    Values,
    check_values,
    copied,
    model_names,
    named_values,
)
from beliefscope.filters.external.derived_values import derived
from beliefscope.filters.external.step_values import stacked
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.external import fill_missing
from beliefscope.inspect.traces.live_file import LiveFileWriter, check_run_name, unused_path
from beliefscope.inspect.traces.run import assemble_trace, step_arrays
from beliefscope.recordings.rerun_log.live_views import LiveViews, write_live_recording

FOLDER = Path("workspace/live")
QUEUE_SIZE = 1000
"""Steps that may be queued (30 MB with 300 particles) before ``step`` blocks."""

BLOCK = 100
"""Maximum number of steps written at once."""

MAX_CHANNELS = 16
"""Channels of innovations for which a file has room, even if the first step has fewer."""


@dataclass(frozen=True)
class _Row:
    """Data of one step: copied NumPy arrays, or tensors that the filter no longer changes."""

    values: StepTrace | Values
    observations: dict[str, NDArray[Any]]
    control: NDArray[Any]
    truth: NDArray[Any]
    contact: bool
    covariates: dict[str, float]
    qpos: NDArray[Any]
    evidence: Evidence | None
    time: float | None


class LiveRecorder:
    """Records the steps of a running filter. Use as a context manager, so that files are complete on any exit.

        with LiveRecorder("run", checkpoint) as live:
            ...
            belief, values = filter.step(belief, evidence[t], generator)
            live.step(values, observations, control, evidence=evidence[t])

    or, for an external filter, with the names of docs/own_filter.md (NumPy or torch, one step):

        with LiveRecorder("run", task="door") as live:
            ...
            live.step({"estimate_mean": mean, "estimate_covariance": covariance}, observations, control)

    ``step`` raises BadInput only at the first step. Later errors are warned about once, and raised when the context
    ends.

    Attributes:
        path: of the ``.live`` file; the ``.rrd`` has the same name. A number is appended if the name exists.
        steps: number of recorded steps.
        waited: number of steps for which ``step`` blocked because the queue was full.
        lost: number of steps that could not be written: full disk, or arrays unlike those of the first step.
    """

    def __init__(
        self,
        name: str,
        checkpoint: Checkpoint | None = None,
        *,
        task: str | Task = "",
        modalities: Sequence[str] = (),
        folder: str | Path = FOLDER,
        start: Gaussian | None = None,
        like: Episode | None = None,
        expected: int | None = None,
        views: bool = True,
        **fields: Any,
    ) -> None:
        """Prepare a recorder; files are created with the first step.

        Args:
            checkpoint: of a Beliefscope filter.
            task: of any other filter: name, ``FILE.py:NAME`` or definition.
            modalities: names of the K measurement models (docs/own_filter.md).
            folder: created if missing. ``beliefscope serve --workspace W`` shows runs in ``W/live``.
            start: belief before step 0, N = 1; standardised for a checkpoint, else in SI units. Default: NaN.
            like: episode that provides dt, seed, split and provenance of the run.
            expected: number of steps, for progress display.
            views: whether to write an ``.rrd`` too.
            fields: fields of the trace that describe its origin: filter, seed, faults, data_hash, settings, ...

        Raises:
            BadInput: neither a checkpoint nor a task is given, the task is unknown, or the name is invalid.
        """
        if checkpoint is None and not task:
            raise BadInput("a live run needs the filter's checkpoint or the name of its task")
        check_run_name(name)
        self._task = load_task(task) if checkpoint is None else checkpoint.task
        self._checkpoint, self._modalities, self._start, self._expected = checkpoint, modalities, start, expected
        self._fields = {"settings": {"torch": torch.__version__}} | fields
        self._origin: dict[str, Any] = (
            {"dt": self._task.dt, "seed": -1, "split": "test", "provenance": {"live": True}}
            if like is None
            else {key: getattr(like, key) for key in ("dt", "seed", "split", "provenance")}
        )
        self.path = unused_path(Path(folder), name)
        self.steps = self.waited = self.lost = 0
        self._error: BadInput | None = None
        self._closed = False
        self._queue: queue.Queue[_Row | BadInput | None] = queue.Queue(QUEUE_SIZE)
        self._writing = threading.Thread(target=self._write, name="live-data", daemon=True)
        self._views = LiveViews(self.path) if views else None
        self._writer: LiveFileWriter | None = None
        self._sizes = {"n": len(self._task.components)}
        self._channels = 0  # of innovations
        task = self._task  # last readings of sensors with absent ones
        self._held: dict[str, Any] = {key: np.zeros(task.observations[key], task.dtype(key)) for key in task.masks}
        self._times: tuple[float, float] | None = None  # of the first and the last written step

    def step(
        self,
        values: StepTrace | Mapping[str, Any] | tuple[Any, Any] | ArrayLike,
        observations: Mapping[str, ArrayLike],
        control: ArrayLike | None = None,
        *,
        truth: ArrayLike | None = None,
        contact: bool | None = None,
        covariates: Mapping[str, float | bool | str | None] = MappingProxyType({}),
        qpos: ArrayLike = (),
        evidence: Evidence | None = None,
        time: float | None = None,
    ) -> None:
        """Queue one step. Arrays are copied, except those in a StepTrace and its evidence.

        Args:
            values: StepTrace returned by the filter's ``step``; for an external filter the mean, (mean, covariance), or
                a dictionary. The batch axis N = 1 may be missing.
            observations: by the task's keys; some may be missing, at all steps. Those with a period (``Task.periods``)
                or mask (``Task.masks``) may be missing at single steps, which repeat the last reading.
            control: (c,).
            truth: (n,) true state, if measured, or with quaternions (``Task.states``). Default: NaN.
            contact: whether the robot truly touches the object. Default: the observation ``contact``, if any.
            covariates: values of the task's other covariates: number, bool or name of a group; unknown if missing.
            qpos: (nq,) joint positions for the replay of the task's simulation.
            evidence: input of the filter's ``step`` that returned the StepTrace.
            time: of the step, s of any clock; at all steps or none. Default: steps times the task's ``dt``.

        Raises BadInput at the first step only, for invalid values and if the files cannot be created.
        """
        try:
            for key in observations:
                check_name(f"sensor of task {self._task.name!r}", key, self._task.observations)
            arrays = self._held | {key: np.array(value) for key, value in observations.items()}
            self._held = {key: arrays[key] for key in (*self._task.periods, *self._task.masks) if key in arrays}
            covariates = {name: key in observations for key, name in self._task.masks.items()} | dict(covariates)
            row: _Row | BadInput = _Row(
                values
                if isinstance(values, StepTrace)
                else _with_batch_axis(copied(named_values(_tensors(values), "the filter", self._task))),
                {key: value if value.dtype == np.uint8 else value.astype(np.float32) for key, value in arrays.items()},
                np.array(np.zeros(self._task.control_size) if control is None else control, np.float32),
                self._task.states(np.array(np.full(self._sizes["n"], np.nan) if truth is None else truth, np.float32)),
                bool(np.any(arrays.get("contact", False))) if contact is None else contact,
                self._covariates(covariates),
                np.array(qpos, np.float32),
                evidence,
                time,
            )
        except Exception as error:
            text = str(error) if isinstance(error, BadInput) else f"{type(error).__name__}: {error}"
            if self._writer is None:
                raise BadInput(text) from None
            row = BadInput(f"step {self.steps}: {text}")
        self.steps += 1
        if self._writer is None and isinstance(row, _Row):
            self._begin(row)
        else:
            self.waited += int(self._queue.full())
            self._queue.put(row)

    def _covariates(self, values: Mapping[str, float | bool | str | None]) -> dict[str, float]:
        """Value of each covariate of the task except contact; NaN if unknown. Raises BadInput for another name."""
        declared = {name: covariate for name, covariate in self._task.covariates.items() if name != "contact"}
        for name, value in values.items():
            check_name(f"covariate of task {self._task.name!r}", name, declared)
            if isinstance(value, str):
                check_name(f"group of covariate {name!r}", value, declared[name].group_names(name))
        given = {name: value for name, value in values.items() if value is not None}
        return {
            name: float(covariate.group_names(name).index(value) if isinstance(value, str) else value)
            for name, covariate in declared.items()
            for value in (given.get(name, np.nan),)
        }

    @property
    def behind(self) -> int:
        """Maximum number of steps by which the ``.rrd`` lagged behind the data."""
        return 0 if self._views is None else self._views.behind

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()
        if kind is None and self._error is not None:
            raise self._error

    def close(self) -> None:
        """Write queued steps, complete the file, and replace the ``.rrd`` by one as written by ``record``."""
        if self._writer is None or self._closed:
            return
        self._closed = True
        self._queue.put(None)
        self._writing.join()
        if self._views is None:
            return
        self._views.close(write_rest=self._error is not None)
        if self._error is None:
            try:
                write_live_recording(self.path, self.path.with_suffix(".rrd"))
            except BadInput as error:
                self._error = error

    def _begin(self, row: _Row) -> None:
        """Create the file with the first step, so that errors are raised immediately."""
        if not isinstance(row.values, StepTrace):
            check_values(row.values, (1,), self._sizes, "the filter")
            if "innovation" in row.values:  # the first step may lack measurements of later ones
                largest = max((shape[0] for shape in self._task.observations.values() if len(shape) == 1), default=0)
                self._channels = max(row.values["innovation"].shape[-1], min(largest, MAX_CHANNELS))
        elif self._checkpoint is None or row.evidence is None:
            raise BadInput("a StepTrace is recorded with its filter's checkpoint and the step's evidence")
        first = self._part([row])
        if first.particles is not None:
            self._fields["settings"] = {"particles": first.particles.shape[1]} | dict(self._fields["settings"])
            first = replace(first, settings=self._fields["settings"])
        shapes = {key: shape for key, shape in self._task.observations.items() if key in row.observations}
        check_shapes(replace(self._task, observations=shapes), first.episode, "the first step")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(f"cannot create folder {str(self.path.parent)!r}: {error.strerror}") from None
        self._writer = LiveFileWriter(self.path, first, self._expected)
        self._writer.append(first)
        self._writing.start()
        if self._views is not None:
            self._views.start()

    def _write(self) -> None:
        """Write queued steps to the file, in larger blocks the more are queued."""
        assert self._writer is not None
        running = True
        while running:
            rows = [self._queue.get()]
            while len(rows) < BLOCK and not self._queue.empty():
                rows.append(self._queue.get())
            running = rows[-1] is not None
            invalid, written = [(i, row) for i, row in enumerate(rows) if isinstance(row, BadInput)], 0
            block = [row for row in rows[: invalid[0][0] if invalid else None] if isinstance(row, _Row)]
            if block and self._error is None:
                try:
                    self._writer.append(self._part(block))
                    written = len(block)
                except BadInput as error:
                    self._fail(error)
                except Exception as error:
                    self._fail(BadInput(f"step {self._writer.steps}: {type(error).__name__}: {error}"))
            if invalid and self._error is None:
                self._fail(invalid[0][1])
            self.lost += sum(row is not None for row in rows) - written
        if self._error is None:
            try:
                self._writer.finish()
            except BadInput as error:
                self._fail(error)
        self._writer.close()

    def _fail(self, error: BadInput) -> None:
        assert self._writer is not None
        self._error = error
        warnings.warn(f"live run {str(self.path)!r} ends at step {self._writer.steps}: {error}", stacklevel=2)

    def _part(self, rows: Sequence[_Row]) -> Trace:
        """Steps as a trace, of a Beliefscope or an external filter."""
        episode = Episode(
            task=self._task,
            states=np.stack([row.truth for row in rows]),
            controls=np.stack([row.control for row in rows]),
            observations={key: np.stack([row.observations[key] for row in rows]) for key in rows[0].observations},
            contact=np.array([row.contact for row in rows]),
            qpos=np.stack([row.qpos for row in rows]),
            covariates={
                name: np.array([row.covariates[name] for row in rows], np.float32) for name in rows[0].covariates
            },
            time=self._since_start([row.time for row in rows]),
            **self._origin,
        )
        n = self._sizes["n"]
        unknown = Gaussian(torch.full((1, n), torch.nan), torch.full((1, n, n), torch.nan))
        start = unknown if self._start is None else self._start
        steps = [row.values for row in rows if isinstance(row.values, StepTrace)]
        evidence = [row.evidence for row in rows if row.evidence is not None]
        if self._checkpoint is not None and len(steps) == len(evidence) == len(rows):
            arrays = step_arrays(self._checkpoint, _stack_evidence(evidence), steps)
            return assemble_trace(self._checkpoint, episode, start, arrays, **self._fields)
        return self._external_part(
            [row.values for row in rows if not isinstance(row.values, StepTrace)], episode, start
        )

    def _since_start(self, given: Sequence[float | None]) -> NDArray[np.float64] | None:
        """(T,) s since the run's first step; None if no step has a time."""
        times = np.array([time for time in given if time is not None], np.float64)
        if not len(times) and self._times is None:
            return None
        if len(times) < len(given):
            raise BadInput("a step has no time; give it to all steps or to none")
        start, *last = (times[0],) if self._times is None else self._times
        if error := time_error(np.array([*last, *times])):
            raise BadInput(f"time {error}, counted from the last written step")
        self._times = start, times[-1]
        return times - start

    def _external_part(self, steps: Sequence[Values], episode: Episode, start: Gaussian) -> Trace:
        """Steps of an external filter as a trace, without values that some of the steps lack."""
        n = self._sizes["n"]
        together = stacked(steps, self._channels)
        values = derived({name: _typed(name, value[:, 0]) for name, value in together.items()}, self._task)
        modalities = model_names(values, 1, self._modalities, self._task)
        arrays = {name: np.ascontiguousarray(value.numpy()) for name, value in values.items()}
        fields: dict[str, Any] = {"filter": "own"} | self._fields | fill_missing(arrays, len(modalities))
        return Trace(
            episode=episode,
            modalities=modalities,
            kind="external",
            start_mean=start.mean.reshape(n).float().numpy(),
            start_covariance=start.covariance.reshape(n, n).float().numpy(),
            **fields,
        )


def _tensors(values: Any) -> Any:
    """NumPy arrays and numbers as tensors, including those in a dictionary or pair."""
    if isinstance(values, Mapping):
        return {name: value if name in (*MEASUREMENTS, "extra") else _tensors(value) for name, value in values.items()}
    if isinstance(values, tuple):
        return tuple(map(_tensors, values))
    return values if isinstance(values, Tensor) else torch.from_numpy(np.array(values))


def _with_batch_axis(values: Values) -> Values:
    """Values with the leading batch axis N = 1, added if missing."""
    present = values["estimate_mean"].ndim > 1
    return values if present else {name: value[None] for name, value in values.items()}


def _typed(name: str, value: Tensor) -> Tensor:
    return value.int() if name == "ancestors" else value.float()


def _stack_evidence(evidence: Sequence[Evidence]) -> Evidence:
    """Evidence of T steps, (N, ...) each, as (T, N, ...)."""
    lists = {f.name: [getattr(step, f.name) for step in evidence] for f in dataclasses.fields(Evidence)}
    stacked: dict[str, Any] = {name: torch.stack(values) for name, values in lists.items() if values[0] is not None}
    return Evidence(**({"noise": None, "log_weights": None} | stacked))

"""Curves of a fine-tuning run: a Rerun file that grows with each validation, a running viewer, and TensorBoard logs."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_error
from beliefscope.recordings.rerun_log.diagnostics import slug
from beliefscope.recordings.rerun_log.stream import FileStream, send_layout
from beliefscope.recordings.schema import APPLICATION, STEP

ROOT = "tuning"

Write = Callable[[int, Mapping[str, float]], None]
"""Writes numbers by name at a step."""


def tensorboard_writer(folder: Path) -> Any:
    """A TensorBoard ``SummaryWriter``. Raises BadInput if tensorboardX is not installed."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise BadInput("TensorBoard logs need tensorboardX: pip install 'beliefscope[tensorboard]'") from None
    return SummaryWriter(str(folder))


@contextmanager
def log_curves(
    folder: Path | None, viewer: str = "", warn: Callable[[str], None] = lambda message: None
) -> Iterator[Write]:
    """Yields a function that writes to a Rerun file and, if tensorboardX is installed, to TensorBoard's event file.

    Args:
        folder: of both files; None for no logs.
        viewer: address of a Rerun viewer that receives the same numbers; empty for none.
        warn: called with a message if there will be no TensorBoard logs.
    """
    if folder is None:
        yield lambda step, numbers: None
        return
    with tuning_curves(folder, viewer) as record:
        try:
            writer = tensorboard_writer(folder)
        except BadInput as error:
            warn(f"no TensorBoard logs: {error}")
            yield record
            return

        def write(step: int, numbers: Mapping[str, float]) -> None:
            record(step, numbers)
            for name, value in numbers.items():
                writer.add_scalar(re.sub("[^a-zA-Z0-9/]+", "_", name), value, step)

        with writer:
            yield write


@contextmanager
def tuning_curves(folder: Path, viewer: str = "") -> Iterator[Write]:
    """Yields a function that logs numbers under ``tuning/`` at a step and flushes.

    Numbers are named ``slice/measure``, such as ``clean/position_cm``, or ``loss``. Each measure has a view with one
    line per slice. A resumed run writes another file of the same recording, ``run-2.rrd``; ``rerun run-*.rrd`` shows
    them together.

    Args:
        folder: created if missing.
        viewer: address of a Rerun viewer; empty for none. Rerun warns if the viewer is unreachable, and the run
            continues.

    Raises BadInput for an invalid address and a file that cannot be written.
    """
    number = 1 + sum(1 for _ in folder.glob("run-*.rrd"))
    recording = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:32]
    path = folder / f"run-{number}.rrd"
    file = FileStream(recording)
    streams: list[rr.RecordingStream] = [file]
    if viewer:
        streams.append(rr.RecordingStream(APPLICATION, recording_id=recording))
        try:
            streams[1].connect_grpc(viewer)
        except (RuntimeError, ValueError):
            example = "rerun+http://127.0.0.1:9876/proxy"
            raise BadInput(f"{viewer!r} is not the address of a Rerun viewer, such as {example}") from None
    folder.mkdir(parents=True, exist_ok=True)
    names: list[str] = []

    def write(step: int, numbers: Mapping[str, float]) -> None:
        new = [name for name in numbers if name not in names]
        names.extend(new)
        with _bad_input(path):
            for stream in streams:
                for name in new:
                    slice_, _, measure = name.rpartition("/")
                    stream.log(_path(name), rr.SeriesLines(names=slice_ or measure), static=True)
                stream.set_time(STEP, sequence=step)
                for name, value in numbers.items():
                    stream.log(_path(name), rr.Scalars(value))
                if new:
                    send_layout(stream, _layout([name.rpartition("/")[2] for name in names]))
            file.flush()  # the file only: do not wait for the viewer

    with _bad_input(path):
        file.save(path)
    try:
        yield write
    finally:
        with _bad_input(path):
            for stream in reversed(streams):
                stream.disconnect()


@contextmanager
def _bad_input(path: Path) -> Iterator[None]:
    """Write errors as BadInput."""
    try:
        yield
    except OSError as error:
        raise write_error(path, error) from None


@contextmanager
def log_losses(folder: Path | None) -> Iterator[Callable[[str, str, int, float], None]]:
    """Yields (kind of loss, stage, step, loss) -> None, which writes to TensorBoard's event file in the folder."""
    if folder is None:
        yield lambda kind, stage, step, loss: None
        return
    with tensorboard_writer(folder) as writer:
        # Tags must not contain spaces or commas.
        yield lambda kind, stage, step, loss: writer.add_scalar(
            f"{re.sub('[^a-z0-9]+', '_', stage)}/{kind}", loss, step
        )


def _path(name: str) -> str:
    slice_, _, measure = name.rpartition("/")
    return f"{ROOT}/{slug(measure)}/{slug(slice_) if slice_ else 'run'}"


def _layout(measures: list[str]) -> rrb.Blueprint:
    views = [rrb.TimeSeriesView(origin=f"{ROOT}/{slug(measure)}", name=measure) for measure in dict.fromkeys(measures)]
    return rrb.Blueprint(rrb.Grid(*views), rrb.TimePanel(state="collapsed", timeline=STEP), auto_views=False)

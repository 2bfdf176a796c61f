"""How a fine-tuning goes, for Rerun: a file that grows look by look, and a viewer that is open beside it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.rerun_log.diagnostics import slug
from beliefscope.recordings.schema import APPLICATION, STEP

ROOT = "tuning"


@contextmanager
def tuning_curves(folder: Path, viewer: str = "") -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """Yields (step, numbers by name) -> None, which writes them under ``tuning/`` at that step, and flushes.

    A number is called ``slice/measure``, such as ``nominal/position_cm``, or ``loss``; measures get a view each, with a
    line a slice. A run that goes on after a kill writes the next file, ``run-2.rrd``, of the same recording:
    ``rerun run-*.rrd`` shows both as one.

    Args:
        folder: made if new. viewer: address of a Rerun viewer to show them in as well; none where empty. One that is
            not there, or goes, is warned of by Rerun; the run does not wait for it.

    Raises BadInput for what is no address.
    """
    number = 1 + sum(1 for _ in folder.glob("run-*.rrd"))
    recording = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:32]
    streams = [rr.RecordingStream(APPLICATION, recording_id=recording) for _ in range(2 if viewer else 1)]
    if viewer:
        try:
            streams[1].connect_grpc(viewer)
        except (RuntimeError, ValueError):
            example = "rerun+http://127.0.0.1:9876/proxy"
            raise BadInput(f"{viewer!r} is no address of a Rerun viewer; write it as {example}") from None
    folder.mkdir(parents=True, exist_ok=True)
    streams[0].save(folder / f"run-{number}.rrd")
    named: list[str] = []

    def write(step: int, numbers: Mapping[str, float]) -> None:
        parts = {name: name.rpartition("/") for name in numbers}
        new = [name for name in parts if name not in named]
        named.extend(new)
        for stream in streams:
            for name in new:
                of, _, measure = parts[name]
                stream.log(_path(of, measure), rr.SeriesLines(names=of or measure), static=True)
            if new:
                stream.send_blueprint(_layout([name.rpartition("/")[2] for name in named]))
            stream.set_time(STEP, sequence=step)
            for name, value in numbers.items():
                of, _, measure = parts[name]
                stream.log(_path(of, measure), rr.Scalars(value))
        streams[0].flush()  # the viewer is not waited for

    try:
        yield write
    finally:
        for stream in streams:
            stream.disconnect()


def _path(of: str, measure: str) -> str:
    return f"{ROOT}/{slug(measure)}/{slug(of) if of else 'run'}"


def _layout(measures: list[str]) -> rrb.Blueprint:
    views = [rrb.TimeSeriesView(origin=f"{ROOT}/{slug(one)}", name=one) for one in dict.fromkeys(measures)]
    return rrb.Blueprint(rrb.Grid(*views), rrb.TimePanel(state="collapsed", timeline=STEP), auto_views=False)

"""``beliefscope convert``"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import Json, SkipBad, TaskName, check, dataset, size

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode


def convert(
    task: TaskName,
    data: Annotated[
        Path, typer.Option("--data", metavar="FILE|DIR", help="Files of others: see docs/data.md for which are known.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.h5", help="Where to write the episodes.")],
    skip_bad: SkipBad = False,
    json: Json = None,
) -> None:
    """Turn others' files into one HDF5 file of ours.

    Every command takes them as they are; a converted file opens faster and has the same hash. Known are the pushes of
    the MIT data set and the files of the paper's authors.

    \b
    Examples:
      beliefscope convert push-real --data mit_push -o pushes.h5
      beliefscope convert door --data panda_door_push_100.hdf5 -o doors.h5
    """
    from beliefscope.datasets.catalog import load_task
    from beliefscope.datasets.store import write_dataset

    check(output, json)
    known = load_task(task)
    with dataset(known, data, skip_bad) as episodes, console.progress("Converting") as advance:

        def counted() -> Iterator[Episode]:
            for index in range(len(episodes)):
                yield episodes[index]
                advance((index + 1) / len(episodes))

        write_dataset(output, known, counted())
        document = {
            "task": known.name,
            "episodes": len(episodes),
            "left_out": list(episodes.left_out),
            "data_hash": episodes.hash,
            "path": str(output),
            "bytes": output.stat().st_size,
        }
    console.result(document, f"{size(output)}: {document['episodes']} episodes of {known.name}", json)

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.text import plural

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode


def convert(
    task: str,
    data: Path = opt.option("FILE|DIR", "Files in a supported format (docs/data.md)."),
    output: Path = opt.DATASET,
    skip_bad: bool = False,
) -> console.Result:
    """Convert external data to a Beliefscope HDF5 file.

    Every command also reads the external files directly; a converted file opens faster and has the same hash.
    Supported are the MIT Push data set and the files published with the paper.

    \b
    Examples:
      beliefscope convert push-real --data mit_push -o pushes.h5
      beliefscope convert door --data panda_door_push_100.hdf5 -o doors.h5
    """
    from beliefscope.datasets.catalog import load_task
    from beliefscope.datasets.store import write_dataset

    target = load_task(opt.definition_of(task, data))
    with opt.open_episodes(target, data, skip_bad) as episodes, console.progress("Converting") as advance:

        def read() -> Iterator[Episode]:
            for index in range(len(episodes)):
                yield episodes[index]
                advance((index + 1) / len(episodes))

        write_dataset(output, target, read())
        document = {
            "task": target.name,
            "episodes": len(episodes),
            "left_out": list(episodes.skipped),
            "data_hash": episodes.hash,
        }
    return console.Result(document, f"{plural(len(episodes), 'episode')} of {target.name}", output)

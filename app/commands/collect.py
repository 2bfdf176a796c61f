"""``beliefscope collect``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app import console
from beliefscope.app.commands.given import Json, Seed, TaskName, check, size, whole


def collect(
    task: TaskName,
    episodes: Annotated[int, typer.Option("--episodes", parser=whole(1), metavar="N", help="How many to simulate.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.h5", help="Where to write them.")],
    steps: Annotated[
        int, typer.Option("--steps", parser=whole(2), metavar="T", help="Length of each, 0.1 s a step.")
    ] = 200,
    workers: Annotated[
        int | None, typer.Option("--workers", parser=whole(1), metavar="W", help="Processes. Without it: one a core.")
    ] = None,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Simulate episodes into one HDF5 file.

    The same seed gives the same data, with any number of workers. A run that was killed goes on where it stopped
    when it is started again. Of every ten episodes eight are for training, one is for validation and one for tests.

    \b
    Example:
      beliefscope collect door --episodes 60 --steps 800 --seed 0 -o door.h5
    """
    from beliefscope.datasets.collect import collect as simulate
    from beliefscope.datasets.store import open_dataset

    check(output, json)
    with console.progress(f"Simulating {task}") as advance:
        simulate(task, episodes, steps, seed, workers, output, lambda done, count: advance(done / count))
    with open_dataset(output) as data:
        contact = sum(s.contact_fraction for s in data.summaries) / len(data)
        document = {
            "task": task,
            "episodes": len(data),
            "steps": steps,
            "seed": seed,
            "contact_fraction": contact,
            "data_hash": data.hash,
            "path": str(output),
            "bytes": output.stat().st_size,
        }
    console.result(document, f"{size(output)}: {episodes} episodes of {steps} steps, {contact:.0%} in contact", json)

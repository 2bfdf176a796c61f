"""``beliefscope train``"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import (
    DataPath,
    FaultsText,
    Json,
    Seed,
    SkipBad,
    TaskName,
    check,
    dataset,
    faults,
    size,
)
from beliefscope.datasets.errors import BadInput, one_of


def train(
    task: TaskName,
    filter_: Annotated[
        str,
        typer.Option(
            "--filter",
            metavar="NAME",
            help="{crossmodal,unimodal,feature,image,haptics}-{ekf,pf}, crossmodal-ukf or lstm (docs/filters.md).",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="CHECKPOINT", help="The .safetensors file to write.")
    ],
    data: DataPath = None,
    skip_bad: SkipBad = False,
    preset: Annotated[
        str,
        typer.Option(
            "--preset", metavar="NAME", help="cpu: about 10 minutes on 2 cores. full: for a GPU. smoke: a trial."
        ),
    ] = "cpu",
    blackouts: Annotated[
        str,
        typer.Option(
            "--blackouts",
            metavar="P,P,...",
            help="Chances of a black picture, one of which is drawn for each training window.",
        ),
    ] = "0,0.4,0.8",
    faults_: FaultsText = "",
    seed: Seed = 0,
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="DIR", help="Write training and validation loss there, for TensorBoard."),
    ] = None,
    json: Json = None,
) -> None:
    """Train a filter and write its checkpoint.

    In the paper's order: dynamics, each modality's model, each modality alone through the filter, the weight model
    alone, everything together. Uses a CUDA GPU where there is one. The checkpoint tells how it was made and how
    well it does on episodes it has not seen. With a faults it also trains on a broken copy of each training episode.
    What is finished lies in CHECKPOINT.partial: the same command, run again after a kill, goes on from there.

    \b
    Examples:
      beliefscope train door --filter crossmodal-pf -o mine.safetensors
      beliefscope train door --filter crossmodal-ekf --data door.h5 --preset full -o mine.safetensors
      beliefscope train door --filter crossmodal-pf --faults force_bias:x=5,force_noise=3 -o hardened.safetensors
    """
    from beliefscope.datasets.catalog import load_task
    from beliefscope.datasets.faults.injection import broken_copies
    from beliefscope.filters.catalog import architecture
    from beliefscope.filters.checkpoint import save_checkpoint
    from beliefscope.filters.training.stages import BLACKOUTS
    from beliefscope.filters.training.train import PLANS
    from beliefscope.filters.training.train import train as train_filter

    check(output, json)
    if log is not None and (log.exists() and not log.is_dir()):
        raise BadInput(f"--log {str(log)!r} is a file; give the name of a folder")
    chosen = architecture(load_task(task).name, filter_)
    black = chances(blackouts)
    if preset not in PLANS:
        raise one_of("preset", preset, PLANS)
    # Where on this machine the data lie is no part of the record; their hash is.
    given = "" if data is None else f" --data {data.name}"
    broken = faults(faults_, load_task(task))
    partial = output.with_name(f"{output.name}.partial")
    given += f" --faults {broken}" if broken else ""
    given += "" if black == BLACKOUTS else f" --blackouts {blackouts}"
    with dataset(load_task(task), data, skip_bad) as episodes, console.bars() as move, losses(log) as write:

        def report(stage: str, done: int, count: int, loss: float) -> None:
            move(stage, done / count, f"loss {loss:.3g}")
            write("training", stage, done, loss)

        whole = list(episodes)
        trained = train_filter(
            chosen,
            whole + (broken_copies(broken, whole, seed) if broken else []),
            data_hash=episodes.hash,
            plan=PLANS[preset],
            seed=seed,
            blackouts=black,
            command=f"beliefscope train {task} --filter {filter_}{given} --preset {preset} --seed {seed}",
            report=report,
            validated=lambda stage, done, count, loss: write("validation", stage, done, loss),
            resumed=lambda stage: console.say(f"goes on after stage {stage!r}, from {partial.name}"),
            partial=partial,
        )
    record = trained.record | {"faults": broken.to_json()}
    checkpoint_hash = save_checkpoint(trained.filter, filter_, record, output)
    document = {
        "task": task,
        "filter": filter_,
        "checkpoint_hash": checkpoint_hash,
        "path": str(output),
        "bytes": output.stat().st_size,
        "record": record,
    }
    lines = [f"{size(output)}: {filter_}, trained in {record['seconds']:.0f} s"]
    for name, metrics in record["metrics"].get("0", {}).items():
        lines.append(f"{name}: " + ", ".join(f"{key} {value:.2f}" for key, value in metrics["rmse"].items()))
    console.result(document, "\n".join(lines), json)


def chances(text: str) -> tuple[float, ...]:
    """Reads ``0,0.4,0.8``. Raises BadInput where a part is not a chance."""
    found = []
    for part in text.split(","):
        try:
            found.append(float(part))
        except ValueError:
            found.append(-1.0)
        if not 0.0 <= found[-1] <= 1.0:
            raise BadInput(f"--blackouts {text!r}: {part!r} is not a chance from 0 to 1")
    return tuple(found)


@contextmanager
def losses(folder: Path | None) -> Iterator[Callable[[str, str, int, float], None]]:
    """Yields (kind of loss, stage, step, loss) -> None, which writes TensorBoard's event file into the folder."""
    if folder is None:
        yield lambda kind, stage, step, loss: None
        return
    from tensorboardX import SummaryWriter

    with SummaryWriter(str(folder)) as writer:
        # Tags hold neither spaces nor commas.
        yield lambda kind, stage, step, loss: writer.add_scalar(
            f"{re.sub('[^a-z0-9]+', '_', stage)}/{kind}", loss, step
        )

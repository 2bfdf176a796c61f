"""``beliefscope train``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app import console
from beliefscope.app.commands.given import (
    DataPath,
    Json,
    RecipeText,
    Seed,
    SkipBad,
    TaskName,
    check,
    dataset,
    recipe,
    size,
)
from beliefscope.datasets.errors import one_of


def train(
    task: TaskName,
    filter_: Annotated[str, typer.Option("--filter", metavar="NAME", help="crossmodal-ekf or crossmodal-pf.")],
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
    recipe_: RecipeText = "",
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Train a filter and write its checkpoint.

    In the paper's order: dynamics, each modality's model, each modality alone through the filter, the weight model
    alone, everything together. Uses a CUDA GPU where there is one. The checkpoint tells how it was made and how
    well it does on episodes it has not seen. With a recipe it also trains on a broken copy of each training episode.

    \b
    Examples:
      beliefscope train door --filter crossmodal-pf -o mine.safetensors
      beliefscope train door --filter crossmodal-ekf --data door.h5 --preset full -o mine.safetensors
      beliefscope train door --filter crossmodal-pf --recipe force_bias:x=5,force_noise=3 -o hardened.safetensors
    """
    from beliefscope.datasets.catalog import find_task
    from beliefscope.datasets.corrupt import broken_copies
    from beliefscope.filters.catalog import architecture
    from beliefscope.filters.checkpoint import save_checkpoint
    from beliefscope.filters.train import PLANS
    from beliefscope.filters.train import train as train_filter

    check(output, json)
    chosen = architecture(find_task(task).name, filter_)
    if preset not in PLANS:
        raise one_of("preset", preset, PLANS)
    # Where on this machine the data lie is no part of the record; their hash is.
    given = "" if data is None else f" --data {data.name}"
    broken = recipe(recipe_, find_task(task))
    given += f" --recipe {broken}" if broken else ""
    with dataset(find_task(task), data, skip_bad) as episodes, console.bars() as move:
        whole = list(episodes)
        trained = train_filter(
            chosen,
            whole + (broken_copies(broken, whole, seed) if broken else []),
            data_hash=episodes.hash,
            plan=PLANS[preset],
            seed=seed,
            command=f"beliefscope train {task} --filter {filter_}{given} --preset {preset} --seed {seed}",
            report=lambda stage, done, count, loss: move(stage, done / count, f"loss {loss:.3g}"),
        )
    record = trained.record | {"recipe": broken.to_json()}
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

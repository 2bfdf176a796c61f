"""``beliefscope train``"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output as console
from beliefscope.datasets.errors import BadInput, unknown_name

ARCHITECTURES = "{crossmodal,unimodal,feature,image,haptics}-{ekf,pf}, crossmodal-ukf or lstm (docs/filters.md)."
PRESETS = "cpu: about 10 minutes on 2 cores. full: for a GPU. smoke: quick test."

Blackouts = Annotated[
    str,
    typer.Option(
        metavar="P,P,...", help="Probabilities of image blackout; each training window uses one of them at random."
    ),
]


def train(
    task: opt.TaskName,
    filter_: Annotated[str, typer.Option("--filter", metavar="NAME", help=ARCHITECTURES)],
    output: opt.CheckpointPath,
    data: opt.DataPath = None,
    skip_bad: opt.SkipBad = False,
    preset: Annotated[str, typer.Option(metavar="NAME", help=PRESETS)] = "cpu",
    blackouts: Blackouts = "0,0.4,0.8",
    faults_: opt.FaultsText = "",
    seed: opt.Seed = 0,
    log: opt.LogFolder = None,
    json: opt.Json = None,
) -> None:
    """Train a filter and write its checkpoint.

    Trains in the order of the paper: dynamics, measurement models, unimodal filters, weight model, end to end. Uses a
    CUDA GPU if available. The checkpoint contains its training record and its metrics on held-out episodes. With
    --faults, a faulty copy of each training episode is added. Completed stages are saved in CHECKPOINT.partial; the
    same command resumes an interrupted run.

    \b
    Examples:
      beliefscope train door --filter crossmodal-pf -o mine.safetensors
      beliefscope train door --filter crossmodal-ekf --data door.h5 --preset full -o mine.safetensors
      beliefscope train door --filter crossmodal-pf --faults force_bias:x=5,force_noise=3 -o hardened.safetensors
    """
    from beliefscope.datasets.catalog import load_task
    from beliefscope.datasets.faults.injection import faulty_copies
    from beliefscope.filters.catalog import architecture
    from beliefscope.filters.checkpoint import save_checkpoint
    from beliefscope.filters.training.plan import BLACKOUTS, PLANS
    from beliefscope.filters.training.train import train as train_filter

    opt.check_output(output)
    opt.check_folder(log, "--log")
    target = load_task(task)
    settings = architecture(target.name, filter_)
    probabilities = _parse_probabilities(blackouts)
    if preset not in PLANS:
        raise unknown_name("preset", preset, PLANS)
    faults = opt.parse_faults(faults_, target)
    partial = output.with_name(f"{output.name}.partial")
    # The record has the name and hash of the data, but not their folder.
    source = "" if data is None else f" --data {data.name}"
    source += f" --faults {faults}" if faults else ""
    source += "" if probabilities == BLACKOUTS else f" --blackouts {blackouts}"
    with opt.open_episodes(target, data, skip_bad) as dataset, console.bars() as update, _log_losses(log) as write:

        def report(stage: str, step: int, steps: int, loss: float) -> None:
            update(stage, step / steps, f"loss {loss:.3g}")
            write("training", stage, step, loss)

        episodes = list(dataset)
        trained = train_filter(
            settings,
            episodes + (faulty_copies(faults, episodes, seed) if faults else []),
            data_hash=dataset.hash,
            plan=PLANS[preset],
            seed=seed,
            blackouts=probabilities,
            command=f"beliefscope train {task} --filter {filter_}{source} --preset {preset} --seed {seed}",
            report=report,
            on_validation=lambda stage, step, _, loss: write("validation", stage, step, loss),
            on_resume=lambda stage: console.note(f"resuming after stage {stage!r}, from {partial.name}"),
            partial=partial,
        )
    record = trained.record | {"faults": faults.to_json()}
    checkpoint_hash = save_checkpoint(trained.filter, filter_, record, output)
    lines = [f"{opt.path_and_size(output)}: {filter_}, trained in {record['seconds']:.0f} s"]
    for name, metrics in record["metrics"].get("0", {}).items():
        lines.append(f"{name}: " + ", ".join(f"{key} {value:.2f}" for key, value in metrics["rmse"].items()))
    opt.print_checkpoint(output, task, filter_, checkpoint_hash, record, "\n".join(lines), json)


def _parse_probabilities(text: str) -> tuple[float, ...]:
    """Parse ``0,0.4,0.8``. Raises BadInput for values that are not probabilities."""
    values = []
    for part in text.split(","):
        try:
            values.append(float(part))
        except ValueError:
            values.append(-1.0)
        if not 0.0 <= values[-1] <= 1.0:
            raise BadInput(f"--blackouts {text!r}: {part!r} is not a probability from 0 to 1")
    return tuple(values)


@contextmanager
def _log_losses(folder: Path | None) -> Iterator[Callable[[str, str, int, float], None]]:
    """Yields (kind of loss, stage, step, loss) -> None, which writes to TensorBoard's event file in the folder."""
    if folder is None:
        yield lambda kind, stage, step, loss: None
        return
    from beliefscope.recordings.rerun_log.training_curves import tensorboard_writer

    with tensorboard_writer(folder) as writer:
        # Tags must not contain spaces or commas.
        yield lambda kind, stage, step, loss: writer.add_scalar(
            f"{re.sub('[^a-z0-9]+', '_', stage)}/{kind}", loss, step
        )

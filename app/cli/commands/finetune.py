"""``beliefscope finetune``"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output as console
from beliefscope.app.cli.commands.modules import Freeze, Train
from beliefscope.app.runs.command_lines import finetune_command
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.datasets.task import Task
    from beliefscope.filters.finetuning.finetune import FineTuned
    from beliefscope.filters.finetuning.loop import Validation
    from beliefscope.filters.finetuning.settings import FineTune

Target = Annotated[
    str, typer.Argument(metavar="TASK|CHECKPOINT", help="Task of the filter given with --filter, or .safetensors file.")
]
Filter = Annotated[
    str | None,
    typer.Option("--filter", metavar="NAME|CHECKPOINT", help="Name of a built-in filter, or .safetensors file."),
]
FaultSets = Annotated[
    list[str] | None,
    typer.Option("--faults", metavar="FAULTS", help="Learn a slice of all steps with these sensor faults. Repeatable."),
]
CleanWeight = Annotated[float, typer.Option(metavar="SHARE", help="Weight of clean data in the loss.")]
Events = Annotated[
    list[str] | None,
    typer.Option("--event", metavar="EPISODE[:FIRST-LAST]", help="Learn slices only from these steps. Repeatable."),
]
Steps = Annotated[int, typer.Option(parser=opt.integer(1), metavar="N", help="Maximum number of optimiser steps.")]
Length = Annotated[int, typer.Option(parser=opt.integer(1), metavar="T", help="Window length in steps.")]
Rates = Annotated[
    list[str] | None,
    typer.Option(
        "--rate",
        metavar="R|PATTERN=R",
        help="Learning rate of Adam (default 0.0003), or of modules that match a pattern: 'weight_model=0.0001'.",
    ),
]
Strength = Annotated[float, typer.Option("--l2-sp", metavar="X", help="L2-SP strength (decay to the base weights).")]
Patience = Annotated[
    int, typer.Option(parser=opt.integer(1), metavar="N", help="Stop after N validations without improvement.")
]
Log = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Folder for losses and errors as a Rerun recording and TensorBoard logs."),
]
Viewer = Annotated[
    str, typer.Option(metavar="URL", help="Address of a running Rerun viewer to stream to; requires --log.")
]


def finetune(
    target: Target,
    output: opt.CheckpointPath,
    filter_: Filter = None,
    train: Train = None,
    freeze: Freeze = None,
    slices: opt.SliceTexts = None,
    fault_sets: FaultSets = None,
    clean_weight: CleanWeight = 0.5,
    events: Events = None,
    data: opt.DataPath = None,
    skip_bad: opt.SkipBad = False,
    steps: Steps = 300,
    length: Length = 32,
    rates: Rates = None,
    l2_sp: Strength = 1.0,
    patience: Patience = 6,
    seed: opt.Seed = 0,
    log: Log = None,
    rerun: Viewer = "",
    json: opt.Json = None,
) -> None:
    """Fine-tune modules of a filter.

    Continues training the selected modules from a base checkpoint; all others stay frozen, verified by hash. The loss
    combines the given slices and clean data. Validates every 25 steps and keeps the best weights. The base checkpoint
    is not changed. The same command resumes an interrupted run from CHECKPOINT.partial. Tutorial: docs/finetune.md.

    \b
    Examples:
      beliefscope finetune push --filter crossmodal-ekf --slice 'blackout 0.8' -o finetuned.safetensors
      beliefscope finetune mine.safetensors --train haptics-only --faults blackout=0.95 -o finetuned.safetensors
      beliefscope finetune door --filter crossmodal-pf --freeze dynamics --slice contact -o finetuned.safetensors
      beliefscope finetune door --filter crossmodal-ekf --train noise-only --rate 0.003 -o finetuned.safetensors
    """
    from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint
    from beliefscope.filters.finetuning.settings import FineTune, StepRange

    opt.check_output(output)
    opt.check_folder(log, "--log")
    if rerun and log is None:
        raise BadInput(f"--rerun {rerun!r} requires --log DIR")
    if filter_ is None and not target.endswith(".safetensors"):
        raise BadInput(f"--filter is required: give the filter of task {target!r} to fine-tune")
    base = load_checkpoint(Path(target)) if filter_ is None else opt.open_checkpoint(target, filter_)
    rate, own_rates = _parse_rates(rates or ())
    settings = FineTune(
        train=tuple(train or ()),
        freeze=tuple(freeze or ()),
        mix=_parse_slices(slices or (), fault_sets or (), base.task),
        clean_weight=clean_weight,
        events=tuple(StepRange.parse(text) for text in events or ()),
        steps=steps,
        length=length,
        rate=rate,
        rates=own_rates,
        l2_sp=l2_sp,
        patience=patience,
        seed=seed,
    )
    partial = output.with_name(f"{output.name}.partial")
    with opt.open_episodes(base.task, data, skip_bad) as episodes:
        command = finetune_command(target, filter_, data, settings)
        tuned = _run(base, list(episodes), settings, partial, log, rerun, data_hash=episodes.hash, command=command)
    checkpoint_hash = save_checkpoint(tuned.filter, base.name, tuned.record, output)
    text = _summary(opt.path_and_size(output), tuned.record)
    opt.print_checkpoint(output, base.task.name, base.name, checkpoint_hash, tuned.record, text, json)


def _run(
    base: Any, episodes: list[Any], settings: FineTune, partial: Path, log: Path | None, viewer: str, **source: Any
) -> FineTuned:
    """Fine-tune with progress bars and logs. source: hash of the data and command line, for the record."""
    from beliefscope.filters.finetuning.finetune import finetune as tune
    from beliefscope.filters.finetuning.report import curve_values, error_summary
    from beliefscope.recordings.rerun_log.training_curves import log_curves

    validations: list[Validation] = []
    with console.bars() as update, log_curves(log, viewer, console.note) as write:

        def on_validation(validation: Validation) -> None:
            validations.append(validation)
            write(validation.step, {**curve_values(validation), "score": validation.score})

        def report(step: int, count: int, loss: float) -> None:
            update("Fine-tuning", step / count, f"loss {loss:.3g}; {error_summary(validations[0], validations[-1])}")

        tuned = tune(
            base,
            episodes,
            settings=settings,
            report=report,
            on_validation=on_validation,
            on_resume=lambda step: console.note(f"resuming after step {step}, from {partial.name}"),
            partial=partial,
            **source,
        )
    assert tuned is not None, "runs without a stop callback always complete"
    return tuned


def _parse_slices(texts: Sequence[str], fault_sets: Sequence[str], task: Task) -> tuple[tuple[Any, float], ...]:
    """Slices and their weights from --slice and --faults."""
    from beliefscope.filters.finetuning.slices import Slice, standard_slices

    slices = [Slice.parse(text, standard_slices(task)) for text in texts]
    for text in fault_sets:
        faults = opt.parse_faults(text, task)
        slices.append(Slice(str(faults).replace("=", " ").replace(":", " "), faults))
    return tuple((slice_, 1.0) for slice_ in slices)


def _parse_rates(texts: Sequence[str]) -> tuple[float, tuple[tuple[str, float], ...]]:
    """Parse ``0.001`` and ``PATTERN=0.001`` to the default rate and the rates of patterns."""
    default, rates = 3e-4, []
    for text in texts:
        pattern, _, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            raise BadInput(f"--rate {text!r} is neither a number nor PATTERN=NUMBER") from None
        if pattern:
            rates.append((pattern, value))
        else:
            default = value
    return default, tuple(rates)


def _summary(file: str, record: dict[str, Any]) -> str:
    """File, errors on held-out episodes by slice before and after, and the frozen tensors."""
    lines = [
        f"{file}: {record['base']['name']}, fine-tuned from {record['base']['hash'][:12]}, best validation at step "
        f"{record['best_step']} of {record['steps']}, {record['seconds']:.0f} s"
    ]
    if not record["best_step"]:
        lines.append("No validation improved on the base checkpoint: its weights are unchanged.")
    before, after = (
        {name: {**metrics["rmse"], **metrics} for name, metrics in record["held_out"][state].items()}
        for state in ("before", "after")
    )
    keys = [*next(iter(before.values()))["rmse"], "nll", "nees"]
    rows = [
        [f"{name}: {key}", values[key], after[name][key], _difference(values[key], after[name][key], key)]
        for name, values in before.items()
        for key in keys
    ]
    lines += ["", console.grid("On held-out episodes", ["", "before", "after", "change"], rows)]
    count, digest = record["frozen"]["tensors"], record["frozen"]["after"][:12]
    lines += ["", f"Frozen: {count} tensors, unchanged (hash {digest})." if count else "No tensor was frozen."]
    return "\n".join(lines)


def _difference(before: float | None, after: float | None, key: str) -> str | None:
    """Change in percent for errors; absolute difference for nll and nees."""
    if before is None or after is None:
        return None
    return f"{after - before:+.2f}" if key in ("nll", "nees") or not before else f"{100 * (after / before - 1):+.0f} %"

"""``beliefscope finetune``"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.commands.modules import Freeze, Train
from beliefscope.app.cli.options import (
    DataPath,
    Json,
    Seed,
    SkipBad,
    check,
    checkpoint,
    dataset,
    faults,
    size,
    whole,
)
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.filters.finetuning.finetune import FineTune
    from beliefscope.filters.finetuning.loop import Look


def finetune(
    target: Annotated[
        str,
        typer.Argument(metavar="TASK|CHECKPOINT", help="A task, whose filter --filter names; or a .safetensors file."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CHILD", help="The .safetensors file to write.")],
    filter_: Annotated[
        str | None,
        typer.Option(
            "--filter", metavar="NAME|CHECKPOINT", help="A filter that ships trained, or a .safetensors file."
        ),
    ] = None,
    train: Train = None,
    freeze: Freeze = None,
    slice_: Annotated[
        list[str] | None,
        typer.Option(
            "--slice",
            metavar="SLICE",
            help="What to learn: 'contact', 'no contact', 'blackout 0.8', 'haptics alone', or one of your own, "
            "NAME:faults=FAULTS:contact=yes:only=MODALITY. May be given several times.",
        ),
    ] = None,
    fault_sets: Annotated[
        list[str] | None,
        typer.Option(
            "--faults",
            metavar="FAULTS",
            help="A slice of all steps with sensors broken like this. May be given several times.",
        ),
    ] = None,
    nominal: Annotated[
        float, typer.Option("--nominal", metavar="SHARE", help="Of the loss that data as they are have.")
    ] = 0.5,
    moment: Annotated[
        list[str] | None,
        typer.Option(
            "--moment",
            metavar="EPISODE[:FIRST-LAST]",
            help="Learn slices from these steps only. May be given several times.",
        ),
    ] = None,
    data: DataPath = None,
    skip_bad: SkipBad = False,
    steps: Annotated[
        int, typer.Option("--steps", parser=whole(1), metavar="N", help="Of the optimiser, at most.")
    ] = 300,
    length: Annotated[int, typer.Option("--length", parser=whole(1), metavar="T", help="Steps of a window.")] = 32,
    rate: Annotated[
        list[str] | None,
        typer.Option(
            "--rate",
            metavar="R|PATTERN=R",
            help="Adam's learning rate, 0.0003 without; of the parts that a pattern matches: 'weight_model=0.0001'.",
        ),
    ] = None,
    pull: Annotated[
        float, typer.Option("--pull", metavar="X", help="How strongly weights are drawn back to the parent's.")
    ] = 1.0,
    patience: Annotated[
        int,
        typer.Option("--patience", parser=whole(1), metavar="N", help="Looks without a better one that end the run."),
    ] = 6,
    seed: Seed = 0,
    log: Annotated[
        Path | None,
        typer.Option(
            "--log", metavar="DIR", help="Write losses and errors there, for TensorBoard and as Rerun's run-1.rrd."
        ),
    ] = None,
    rerun: Annotated[
        str,
        typer.Option("--rerun", metavar="URL", help="Of an open Rerun viewer, to show them live; --log is needed too."),
    ] = "",
    json: Json = None,
) -> None:
    """Train parts of a filter further.

    The child goes on from its parent's weights, in the parts that are chosen; all others stay as they are, which the
    child's record proves. It learns the slices given, and nominal data beside them. Of all looks at the validation
    episodes, every 25 steps, the best one's weights are kept. Killed, or stopped with ctrl-c, the same command goes on
    from CHILD.partial. docs/finetune.md tells of a filter that was mended like this.

    \b
    Examples:
      beliefscope finetune push --filter crossmodal-ekf --slice 'blackout 0.8' -o child.safetensors
      beliefscope finetune mine.safetensors --train haptics-only --faults blackout=0.95 -o child.safetensors
      beliefscope finetune door --filter crossmodal-pf --freeze dynamics --slice contact -o child.safetensors
      beliefscope finetune door --filter crossmodal-ekf --train noise-only --rate 0.003 -o child.safetensors
    """
    from beliefscope.datasets.faults.injection import Faults
    from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint
    from beliefscope.filters.finetuning.batch_mix import Moment
    from beliefscope.filters.finetuning.finetune import FineTune
    from beliefscope.filters.finetuning.finetune import finetune as tune
    from beliefscope.filters.finetuning.slices import Slice, slices_of

    check(output, json)
    if log is not None and (log.exists() and not log.is_dir()):
        raise BadInput(f"--log {str(log)!r} is a file; give the name of a folder")
    if rerun and log is None:
        raise BadInput(f"--rerun {rerun!r} shows what --log writes; give --log DIR too")
    if filter_ is None and not target.endswith(".safetensors"):
        raise BadInput(f"--filter is missing: say which filter of task {target!r} to fine-tune")
    parent = load_checkpoint(Path(target)) if filter_ is None else checkpoint(target, filter_)
    chosen: list[Slice] = [Slice.parse(text, slices_of(parent.task)) for text in slice_ or ()]
    for text in fault_sets or ():
        broken: Faults = faults(text, parent.task)
        chosen.append(Slice(str(broken).replace("=", " ").replace(":", " "), broken))
    base, own = rates(rate or ())
    settings = FineTune(
        train=tuple(train or ()),
        freeze=tuple(freeze or ()),
        mix=tuple((one, 1.0) for one in chosen),
        nominal=nominal,
        moments=tuple(Moment.parse(text) for text in moment or ()),
        steps=steps,
        length=length,
        rate=base,
        rates=own,
        pull=pull,
        patience=patience,
        seed=seed,
    )
    partial = output.with_name(f"{output.name}.partial")
    with dataset(parent.task, data, skip_bad) as episodes, console.bars() as move, curves(log, rerun) as write:
        looks: list[Look] = []

        def looked(found: Look) -> None:
            looks.append(found)
            write(
                found.step, {f"{name}/{key}": value for name, said in found.slices.items() for key, value in of(said)}
            )
            write(
                found.step, {"score": found.score} if found.loss is None else {"score": found.score, "loss": found.loss}
            )

        def report(step: int, count: int, loss: float) -> None:
            move("Fine-tuning", step / count, f"loss {loss:.3g}; {errors(looks[0], looks[-1])}")

        tuned = tune(
            parent,
            list(episodes),
            data_hash=episodes.hash,
            settings=settings,
            command=command(target, filter_, data, settings),
            report=report,
            looked=looked,
            resumed=lambda step: console.say(f"goes on after step {step}, from {partial.name}"),
            partial=partial,
        )
    assert tuned is not None, "nobody asked to stop"
    record = tuned.record
    checkpoint_hash = save_checkpoint(tuned.filter, parent.name, record, output)
    document = {
        "task": parent.task.name,
        "filter": parent.name,
        "checkpoint_hash": checkpoint_hash,
        "path": str(output),
        "bytes": output.stat().st_size,
        "record": record,
    }
    console.result(document, told(size(output), record), json)


def rates(given: Sequence[str]) -> tuple[float, tuple[tuple[str, float], ...]]:
    """Reads ``0.001`` and ``PATTERN=0.001``: the base rate and those of patterns. Raises BadInput for anything else."""
    base, own = 3e-4, []
    for text in given:
        pattern, _, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            raise BadInput(f"--rate {text!r} is neither a number nor PATTERN=NUMBER") from None
        if pattern:
            own.append((pattern, value))
        else:
            base = value
    return base, tuple(own)


def command(target: str, filter_: str | None, data: Path | None, settings: FineTune) -> str:
    """The command line again, without what it takes anyway, and without where files lie on this machine."""
    from beliefscope.filters.finetuning.finetune import FineTune

    def name(text: str) -> str:
        return Path(text).name if text.endswith(".safetensors") else text

    words = ["beliefscope", "finetune", name(target)]
    words += ["--filter", name(filter_)] if filter_ else []
    words += [word for one in settings.train for word in ("--train", one)]
    words += [word for one in settings.freeze for word in ("--freeze", one)]
    words += [word for one, _ in settings.mix for word in ("--slice", str(one))]
    words += [word for one in settings.moments for word in ("--moment", str(one))]
    words += ["--data", data.name] if data else []
    words += [word for pattern, rate in settings.rates for word in ("--rate", f"{pattern}={rate:g}")]
    for key in ("nominal", "steps", "length", "rate", "pull", "patience"):
        if (value := getattr(settings, key)) != getattr(FineTune(), key):
            words += [f"--{key}", f"{value:g}"]
    return shlex.join([*words, "--seed", str(settings.seed)])


def errors(parent: Look, now: Look) -> str:
    """``nominal 0.34 cm, blackout 0.95 3.14 -> 1.20 cm``: every slice's error of position."""
    return ", ".join(
        f"{name} {change(parent.slices[name]['rmse']['position_cm'], said['rmse']['position_cm'])} cm"
        for name, said in now.slices.items()
    )


def change(before: float, after: float) -> str:
    return f"{before:.2f}" if before == after else f"{before:.2f} -> {after:.2f}"


def of(said: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """A slice's numbers by name, as curves."""
    values = {**said["rmse"], **{key: said[key] for key in ("nll", "nees", "coverage95")}}
    return ((key, value) for key, value in values.items() if value is not None)


def told(sized: str, record: dict[str, Any]) -> str:
    """The result for people: where it is, what it did by slice on held-out episodes, and what did not move."""
    lines = [
        f"{sized}: {record['parent']['name']}, a child of {record['parent']['hash'][:12]}, after {record['best_step']} "
        f"of {record['steps']} steps in {record['seconds']:.0f} s"
    ]
    if not record["best_step"]:
        lines.append("No step did better on the validation episodes than the parent: the weights are the parent's.")
    before, after = record["held_out"]["before"], record["held_out"]["after"]
    keys = [*next(iter(before.values()))["rmse"], "nll", "nees"]
    flat = {name: said["rmse"] | said for name, said in before.items()}, {n: s["rmse"] | s for n, s in after.items()}
    rows = [
        [f"{name}: {key}", flat[0][name][key], flat[1][name][key], share(flat[0][name][key], flat[1][name][key], key)]
        for name in before
        for key in keys
    ]
    lines += ["", console.grid("On held-out episodes", ["", "before", "after", "change"], rows)]
    count, proof = record["frozen"]["tensors"], record["frozen"]["after"][:12]
    lines += ["", f"Frozen: {count} tensors, hash {proof} before and after." if count else "Nothing was frozen."]
    return "\n".join(lines)


def share(before: float | None, after: float | None, key: str) -> str | None:
    """Of an error its change in percent; of others, which have no zero, the difference."""
    if before is None or after is None:
        return None
    return f"{after - before:+.2f}" if key in ("nll", "nees") or not before else f"{100 * (after / before - 1):+.0f} %"


@contextmanager
def curves(folder: Path | None, viewer: str = "") -> Iterator[Callable[[int, dict[str, float]], None]]:
    """Yields (step, numbers by name) -> None, which writes TensorBoard's event file and Rerun's into the folder.

    viewer: address of a Rerun viewer, for the same there; empty for none.
    """
    if folder is None:
        yield lambda step, numbers: None
        return
    from tensorboardX import SummaryWriter

    from beliefscope.recordings.rerun_log.training_curves import tuning_curves

    with tuning_curves(folder, viewer) as record, SummaryWriter(str(folder)) as writer:

        def write(step: int, numbers: dict[str, float]) -> None:
            record(step, numbers)
            for name, value in numbers.items():
                writer.add_scalar(re.sub("[^a-zA-Z0-9/]+", "_", name), value, step)

        yield write

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.report.command_lines import finetune_command

if TYPE_CHECKING:
    from beliefscope.datasets.dataset import Dataset
    from beliefscope.datasets.episode import Episode
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.filters.external.load import ExternalFilter
    from beliefscope.filters.finetuning.finetune import Callbacks
    from beliefscope.filters.finetuning.loop import Validation
    from beliefscope.filters.finetuning.settings import FineTune
    from beliefscope.inspect.compare.success import Success


@dataclass(frozen=True)
class Learning:
    """Options of fine-tuning: modules, data and training."""

    train: list[str] | None = None
    freeze: list[str] | None = None
    slices: list[str] | None = None
    fault_sets: list[str] | None = opt.option(
        "FAULTS", "Train on a slice of all steps with these sensor faults. Repeatable.", None, "--faults"
    )
    clean_weight: float | None = opt.option(
        "SHARE",
        "Weight of clean data in the loss (default 0.5; in the default run of a filter with images 0.97).",
        None,
    )
    events: list[str] | None = opt.option(
        "EPISODE[:FIRST-LAST]",
        "Restrict the slices to an episode, or to some of its steps. Repeatable.",
        None,
        "--event",
    )
    data: Path | None = None
    skip_bad: bool = False
    steps: int | None = opt.option(
        "N", "Maximum number of optimiser steps (default 300; in the default run 150).", None, parser=opt.integer(1)
    )
    length: int = opt.option("T", "Window length in steps.", 32, parser=opt.integer(1))
    rates: list[str] | None = opt.option(
        "R|PATTERN=R",
        "Learning rate of Adam (default 0.0003), or of modules that match a pattern: 'weight_model=0.0001'.",
        None,
        "--rate",
    )
    l2_sp: float = opt.option("X", "L2-SP strength (decay towards the base weights).", 1.0)
    calibrate: bool = opt.flag(
        "At the end, scale process and measurement noise such that NEES/n is 1 on the validation episodes."
    )
    patience: int = opt.option("N", "Stop after N validations without improvement.", 6, parser=opt.integer(1))
    seed: int = 0
    success: str | None = opt.option(
        "SLICE[:by=10%:others=5%]",
        "Success criterion: the error falls by at least 'by' in the slice and rises by at most 'others' elsewhere.",
        None,
    )

    def settings(self, base: Checkpoint) -> FineTune:
        """The settings, completed by defaults for the filter. Raises BadInput if they do not fit it."""
        from beliefscope.filters.finetuning.defaults import settings_from
        from beliefscope.filters.finetuning.success import Criterion

        names = ("clean_weight", "steps", "length", "l2_sp", "calibrate", "patience", "seed")
        values = {name: getattr(self, name) for name in names}
        values["success"] = Criterion.parse(self.success) if self.success else None
        selected = self.train, self.freeze, self.slices, self.fault_sets, self.events, self.rates
        return settings_from(base, *selected, **values)


def finetune(
    *,
    target: str = opt.argument("TASK|CHECKPOINT", "Task of the filter given with --filter, or .safetensors file."),
    output: Path = opt.CHECKPOINT,
    filter: str | None = opt.option(
        "NAME|CHECKPOINT|FILE.py:FUNCTION",
        "Pretrained filter, path of a .safetensors file, or external filter given by its build function.",
        None,
    ),
    learning: Learning,
    log: Path | None = opt.option(
        "DIR", "Folder for losses and errors as a Rerun recording and TensorBoard logs.", None
    ),
    rerun: str = opt.option("URL", "Address of a running Rerun viewer to stream to; requires --log.", ""),
) -> console.Result:
    """Fine-tune modules of a filter.

    Continues training the selected modules from a base checkpoint; all others stay frozen, verified by hash. The loss
    combines the given slices and clean data. Validates every 25 steps and keeps the best weights. The base checkpoint
    is not changed. The same command resumes an interrupted run from CHECKPOINT.partial. Tutorial: docs/finetune.md.

    The default run, without --train, --freeze, --slice, --faults and --event, trains for 150 steps on a sensor fault
    that the training data lack: occluded or noisy images or, for a filter without images, noisy haptics.

    To fine-tune an external filter, define loss(module, windows) in the file of its build function. CHECKPOINT then has
    the weights of the torch module, and FILE.py:FUNCTION@CHECKPOINT is the fine-tuned filter.

    \b
    Examples:
      beliefscope finetune push --filter crossmodal-ekf -o finetuned.safetensors
      beliefscope finetune door --filter own.py:build --freeze dynamics -o finetuned.safetensors
      beliefscope finetune push --filter crossmodal-ekf --slice 'blackout 0.8' -o finetuned.safetensors
      beliefscope finetune mine.safetensors --train haptics-only --faults blackout=0.95 -o finetuned.safetensors
      beliefscope finetune door --filter crossmodal-pf --freeze dynamics --slice contact -o finetuned.safetensors
      beliefscope finetune door --filter crossmodal-ekf --train noise-only --rate 0.003 -o finetuned.safetensors
      beliefscope finetune push --filter crossmodal-ekf --slice contact --success contact -o finetuned.safetensors
    """
    from beliefscope.filters.checkpoint import load_checkpoint, partial_path, save_checkpoint
    from beliefscope.filters.external.load import ExternalFilter
    from beliefscope.filters.finetuning.finetune import finetune as tune
    from beliefscope.filters.open_filter import open_filter
    from beliefscope.inspect.healthy import measure_profile

    opt.check_folder(log, "--log")
    if rerun and log is None:
        raise BadInput(f"--rerun {rerun!r} requires --log DIR")
    if filter is None and not target.endswith(".safetensors"):
        raise BadInput(f"--filter is required: give the filter of task {target!r} to fine-tune")
    base = (
        load_checkpoint(Path(target))
        if filter is None
        else open_filter(opt.definition_of(target, learning.data), filter)
    )
    settings, data = learning.settings(base), learning.data
    before, after, verdict = filter or target, str(output), None
    with opt.open_episodes(base.task, data, learning.skip_bad) as episodes:
        members, data_hash = _training_episodes(episodes, data, output.parent)
        command = finetune_command(target, filter, data, settings)
        partial = partial_path(output)
        source: dict[str, Any] = {"data_hash": data_hash, "command": command, "settings": settings, "partial": partial}
        progress = _progress(base, partial, log, rerun)
        if isinstance(base, ExternalFilter):
            before, after = base.source, f"{base.source.partition('@')[0]}@{output}"
            checkpoint_hash, record = _external(base, members, output, source, after, progress)
        else:
            with progress as callbacks:
                tuned = tune(base, members, callbacks=callbacks, **source)
            assert tuned is not None, "runs without a stop callback always complete"
            record = tuned.record
            with console.progress("Measuring the healthy record") as advance:
                profile = measure_profile(tuned.filter, base.name, members, command, data is None, advance)
            checkpoint_hash = save_checkpoint(tuned.filter, base.name, record, output, profile)
            verdict = _judge(settings, base, output, episodes) if settings.success else None
    change = ["beliefscope", "change", before, after, "--task", base.task.name]
    lines = [*_summary(record), "", shlex.join(change + (["--data", str(data)] if data else []))]
    lines += ["", verdict.statement, verdict.verdict] if verdict else []
    names = {"task": base.task.name, "filter": base.name, "checkpoint_hash": checkpoint_hash}
    document = names | {"record": record} | ({"success": verdict} if verdict else {})
    return console.Result(document, "\n".join(lines), output)


def _training_episodes(data: Dataset, path: Path | None, folder: Path) -> tuple[list[Episode], str]:
    """The episodes, and their hash; those of a sample set without training episodes are simulated into ``folder``."""
    if path is not None:
        return list(data), data.hash
    from beliefscope.filters.finetuning.training_data import training_episodes

    with console.bars() as update:

        def on_simulation(done: int, count: int) -> None:
            update(f"Simulating {count} training episodes of {data.task.name}", done / count, "")

        return training_episodes(data.path.name, data, True, folder, on_simulation)


@contextmanager
def _progress(base: Checkpoint, partial: Path, log: Path | None, viewer: str) -> Iterator[Callbacks]:
    """Progress bars and logs of a fine-tuning run."""
    from beliefscope.filters.finetuning.finetune import Callbacks
    from beliefscope.filters.finetuning.report import curve_values, error_summary
    from beliefscope.recordings.rerun_log.training_curves import log_curves

    validations: list[Validation] = []
    with console.bars() as update, log_curves(log, viewer, console.note) as write:

        def on_validation(validation: Validation) -> None:
            validations.append(validation)
            write(validation.step, {**curve_values(validation), "score": validation.score})

        def report(step: int, count: int, loss: float) -> None:
            errors = error_summary(base.task.main_error, validations[0], validations[-1])
            update("Fine-tuning", step / count, f"loss {loss:.3g}; {errors}")

        def on_resume(step: int) -> None:
            console.note(f"resuming after step {step}, from {partial.name}")

        def on_start() -> None:
            console.note("Encoding images and evaluating the base checkpoint")

        def on_evaluation() -> None:
            console.note("Evaluating the fine-tuned checkpoint")

        yield Callbacks(report, on_validation, on_resume, on_start=on_start, on_evaluation=on_evaluation)


def _external(
    base: ExternalFilter,
    episodes: list[Episode],
    output: Path,
    source: Mapping[str, Any],
    name: str,
    progress: AbstractContextManager[Callbacks],
) -> tuple[str, dict[str, Any]]:
    """Fine-tune the module of an external filter on its own loss; hash of the result, and its record.

    source: other arguments of ``finetune_external``. name: of the fine-tuned filter, ``FILE.py:FUNCTION@CHECKPOINT``.
    """
    from beliefscope.filters.external.load import load_external
    from beliefscope.filters.external.module_weights import save_weights
    from beliefscope.filters.finetuning.external import finetune_external, loss_of

    with progress as callbacks:
        result = finetune_external(base, loss_of(base.source), episodes, callbacks=callbacks, **source)
    assert result is not None, "runs without a stop callback always complete"
    tensors, record = result
    save_weights(tensors, output)
    return load_external(name, base.task).hash, record


def _judge(settings: FineTune, base: Checkpoint, output: Path, data: Dataset) -> Success:
    """The outcome by the success criterion, over the held-out episodes."""
    from beliefscope.filters.checkpoint import load_checkpoint
    from beliefscope.inspect.compare.checkpoints import compare_checkpoints
    from beliefscope.inspect.compare.success import judge

    assert settings.success is not None
    with console.progress("Comparing") as advance:
        comparison = compare_checkpoints(
            base,
            load_checkpoint(output, (base.task,)),
            data,
            slices=settings.compared_slices(base.filter),
            seed=settings.seed,
            progress=advance,
        )
    return judge(settings.success, comparison, base.task)


def _summary(record: dict[str, Any]) -> list[str]:
    """Lines about training, errors before and after, and frozen tensors."""
    from beliefscope.filters.finetuning.report import held_out_rows, training_summary
    from beliefscope.inspect.diagnostics.views import format_table

    frozen = record["frozen"]
    unchanged = f"Frozen: {frozen['tensors']} tensors, unchanged (hash {frozen['after'][:12]})."
    return [
        training_summary(record),
        "",
        format_table("On windows of held-out episodes", ["", "before", "after", "change"], held_out_rows(record)),
        "",
        unchanged if frozen["tensors"] else "No tensor was frozen.",
    ]

"""Job that fine-tunes a checkpoint and compares the result with its base."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import closing
from typing import Any

from beliefscope.app.protocol.permalinks import comparison_permalink, permalink
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.worker import Report
from beliefscope.app.workspace.finetune_runs import FineTuneRuns
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from beliefscope.filters.finetuning.finetune import finetune
from beliefscope.filters.finetuning.loop import Validation
from beliefscope.filters.finetuning.report import curve_values, no_change
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.inspect.compare.checkpoints import CheckpointComparison, compare_checkpoints
from beliefscope.inspect.compare.progress_log import ProgressLog
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.healthy import measure_profile

TRAINING_SHARE = 0.8
"""Share of the progress for training; the rest is for the comparison."""


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Fine-tune, resuming if interrupted; write checkpoint and result into the run's folder."""
    from beliefscope.recordings.rerun_log.training_curves import log_curves  # imports Rerun

    settings = Settings.from_json(arguments["server"])
    tuning = FineTune.from_json(arguments["settings"])
    folder = FineTuneRuns(settings.workspace).folder(arguments["run"])
    path = folder / "finetuned.safetensors"
    with closing(TraceStore(settings)) as store:
        base = store.checkpoint(arguments["task"], arguments["filter"])
        data_name, data = store.dataset(arguments["task"], arguments["data"])
        with log_curves(folder / "log") as write:
            log = ProgressLog(folder / "progress.json", tuning.steps, base.task.main_error)

            def on_validation(validation: Validation) -> None:
                log.add_validation(validation)
                write(validation.step, curve_values(validation))

            def on_step(step: int, steps: int, loss: float) -> None:
                log.add_step(step, loss)
                report(TRAINING_SHARE * step / steps, f"step {step} of {steps}, loss {loss:.3g}; {log.errors}")

            episodes = list(data)
            result = finetune(
                base,
                episodes,
                data_hash=data.hash,
                settings=tuning,
                command=f"fine-tuned on the page from {arguments['filter']}",
                report=on_step,
                on_validation=on_validation,
                on_resume=log.resume,
                partial=folder / "finetuned.partial",
            )
            log.write()
        assert result is not None, "finetune returns None only if it is stopped"
        profile = measure_profile(result.filter, base.name, episodes, f"held-out episodes of {data_name}")
        save_checkpoint(result.filter, base.name, result.record, path, profile)
        finetuned = load_checkpoint(path)
        comparison = compare_checkpoints(
            base,
            finetuned,
            data,
            slices=[slice_ for slice_, _ in tuning.mix],
            particles=settings.particles,
            seed=settings.seed,
            progress=lambda share: report(
                TRAINING_SHARE + (1.0 - TRAINING_SHARE) * share, "comparing the result with its base"
            ),
        )
    document = as_json(_result(comparison, finetuned, arguments["filter"], data_name))
    write_atomically(folder / "result.json", json.dumps(document, allow_nan=False).encode())
    return {"verdict": comparison.verdict}


def catalog_name(base: str, hash_: str) -> str:
    """Name of a fine-tuned filter in the catalog: its base's without the hash digits, and its own hash digits."""
    family, dash, digits = base.rpartition("-")
    has_digits = dash and len(digits) == 6 and set(digits) <= set("0123456789abcdef")
    return f"{family if has_digits else base}-{hash_[:6]}"


def _result(comparison: CheckpointComparison, finetuned: Checkpoint, base: str, data: str) -> dict[str, Any]:
    """The result document; each event has a permalink that opens it with the base as comparison run."""
    name = catalog_name(base, finetuned.hash)
    views, event_table = comparison.views(), comparison.event_table().title
    events = []
    for event in comparison.events:
        link = permalink(finetuned.task, name, data, event.episode, event.step, event.faults)
        events.append(as_json(event) | {"link": comparison_permalink(link, event, base)})
    record = {key: finetuned.record[key] for key in ("best_step", "steps", "seconds")}
    record["no_change"] = no_change(finetuned.record)
    return {
        "finetuned": {"name": name, "hash": finetuned.hash} | record,
        "comparison": views | {"tables": [table for table in views["tables"] if table["title"] != event_table]},
        "frozen": comparison.frozen,
        "events": events,
    }

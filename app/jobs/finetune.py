"""Job that fine-tunes a checkpoint, compares the result with its base, and measures its healthy record."""

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from beliefscope.app.protocol.permalinks import comparison_permalink, permalink
from beliefscope.app.runs.trace_store import store_of_job
from beliefscope.app.runs.worker import Report
from beliefscope.app.workspace.finetune_runs import FineTuneRuns
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.filters.checkpoint import Checkpoint, partial_path, save_checkpoint
from beliefscope.filters.engine import one_thread
from beliefscope.filters.finetuning.finetune import Callbacks, finetune
from beliefscope.filters.finetuning.loop import Validation
from beliefscope.filters.finetuning.report import curve_values, no_change
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.training_data import simulated_episodes, training_episodes
from beliefscope.inspect.compare.checkpoints import CheckpointComparison, compare_checkpoints
from beliefscope.inspect.compare.progress_log import ProgressLog, ProgressShares
from beliefscope.inspect.compare.success import judge
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.healthy import measure_profile


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Fine-tune, resuming if interrupted; write checkpoint and result into the run's folder.

    The result is written twice: for display while the healthy record is measured, which takes as long as a short
    training, and with the name and hash of the checkpoint, which contains that record.
    """
    from beliefscope.recordings.rerun_log.training_curves import log_curves  # imports Rerun

    tuning = FineTune.from_json(arguments["tuning"])
    # Threads of torch that wait for a core which the page uses cost more time than they save.
    with store_of_job(arguments) as store, one_thread():
        settings = store.settings
        folder = FineTuneRuns(settings.workspace).folder(arguments["run"])
        path, result_path = folder / "finetuned.safetensors", folder / "result.json"
        result_path.unlink(missing_ok=True)  # of an earlier job
        base = store.checkpoint(arguments["task"], arguments["filter"])
        data_name, data = store.dataset(arguments["task"], arguments["data"])
        is_sample = data_name not in settings.data
        share = ProgressShares(tuning, data, simulated_episodes(data_name, data, is_sample))

        def on_simulation(done: int, count: int) -> None:
            report(share("simulation", done / count), f"simulation: training episode {done} of {count}")

        episodes, data_hash = training_episodes(data_name, data, is_sample, folder.parent, on_simulation)
        with log_curves(folder / "log") as write:
            log = ProgressLog(folder / "progress.json", tuning.steps, base.task.main_error)

            def on_validation(validation: Validation) -> None:
                log.add_validation(validation)
                write(validation.step, curve_values(validation))

            def on_step(step: int, steps: int, loss: float) -> None:
                log.add_step(step, loss)
                message = f"training: step {step} of {steps}, loss {loss:.3g}; {log.errors}"
                report(share("training", step / steps), message)

            def on_evaluation() -> None:
                report(share("training", 1.0), "evaluation: fine-tuned checkpoint on the held-out episodes")

            report(share("training", 0.0), "training: encoding images and evaluating the base checkpoint")
            result = finetune(
                base,
                episodes,
                data_hash=data_hash,
                settings=tuning,
                command=f"fine-tuned on the page from {arguments['filter']}",
                callbacks=Callbacks(on_step, on_validation, log.resume, on_evaluation=on_evaluation),
                partial=partial_path(path),
            )
            log.write()
        assert result is not None, "finetune returns None only if it is stopped"
        finetuned = Checkpoint(result.filter, base.name, "", result.record)
        comparison = compare_checkpoints(
            base,
            finetuned,
            data,
            slices=tuning.compared_slices(base.filter),
            particles=settings.particles,
            seed=settings.seed,
            progress=lambda done: report(share("comparison", done), "evaluation: comparison with the base checkpoint"),
        )
        success = None if tuning.success is None else judge(tuning.success, comparison, base.task)

        def write_result() -> None:
            document = _result(comparison, finetuned, arguments["filter"], data_name) | {"success": success}
            write_atomically(result_path, json.dumps(as_json(document), allow_nan=False).encode())

        def on_profile(done: float) -> None:
            report(share("profile", done), "healthy record: held-out episodes")

        write_result()
        on_profile(0.0)
        source = f"held-out episodes of {data_name}"
        profile = measure_profile(result.filter, base.name, episodes, source, is_sample, on_profile)
        finetuned = replace(finetuned, hash=save_checkpoint(result.filter, base.name, result.record, path, profile))
        write_result()
    return {"verdict": success.verdict if success else comparison.verdict}


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

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.text import plural

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode
    from beliefscope.datasets.task import Task

ARCHITECTURES = (
    "{crossmodal,information,unimodal,feature,image,haptics}-{ekf,pf}, crossmodal-ukf, lstm or transformer "
    "(docs/filters.md)."
)
NETWORKS = "default, or authors: layers and image resolution of the paper's published code (docs/filters.md)."
PROBABILITIES = "Probabilities of image blackout; each training window uses one of them at random."


def train(
    task: str,
    filter: str = opt.option("NAME", ARCHITECTURES),
    output: Path = opt.CHECKPOINT,
    data: Path | None = None,
    skip_bad: bool = False,
    networks: str = opt.option("NAME", NETWORKS, "default"),
    preset: str = opt.option("NAME", "cpu: about 10 minutes on one core. full: for a GPU. smoke: quick test.", "cpu"),
    blackouts: str = opt.option("P,P,...", PROBABILITIES, "0,0.4,0.8"),
    faults: str = "",
    seed: int = 0,
    log: Path | None = None,
) -> console.Result:
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
    from beliefscope.datasets.faults.injection import faulty_copies, read_faults
    from beliefscope.filters.names import check_trainable

    target = load_task(opt.definition_of(task, data))
    check_trainable(target, task, filter)
    from beliefscope.filters.catalog import architecture
    from beliefscope.filters.checkpoint import partial_path, save_checkpoint
    from beliefscope.filters.training.plan import BLACKOUTS, PLANS, parse_blackouts
    from beliefscope.filters.training.train import train as train_filter
    from beliefscope.inspect.healthy import measure_profile
    from beliefscope.recordings.rerun_log.training_curves import log_losses

    settings = architecture(target, filter, networks)
    probabilities = parse_blackouts(blackouts)
    check_name("preset", preset, PLANS)
    injected = read_faults(faults, target)
    partial = partial_path(output)
    # The record has the name and hash of the data, but not their folder.
    source = _option("data", data and data.name) + _option("faults", injected and str(injected))
    source += _option("blackouts", probabilities != BLACKOUTS and blackouts)
    source += _option("networks", networks != "default" and networks)
    with opt.open_episodes(target, data, skip_bad) as dataset, console.bars() as update, log_losses(log) as write:

        def report(stage: str, step: int, steps: int, loss: float) -> None:
            update(stage, step / steps, f"loss {loss:.3g}")
            write("training", stage, step, loss)

        episodes = list(dataset)
        _check_training(target, episodes, sample=data is None)
        trained = train_filter(
            settings,
            episodes + (faulty_copies(injected, episodes, seed) if injected else []),
            data_hash=dataset.hash,
            plan=PLANS[preset],
            seed=seed,
            blackouts=probabilities,
            command=f"beliefscope train {task} --filter {filter}{source} --preset {preset} --seed {seed}",
            report=report,
            on_validation=lambda stage, step, _, loss: write("validation", stage, step, loss),
            on_resume=lambda stage: console.note(f"resuming after stage {stage!r}, from {partial.name}"),
            on_evaluation=lambda done: update("evaluation", done, ""),
            partial=partial,
        )
        record = trained.record | {"faults": injected.to_json()}

        def report_record(done: float) -> None:
            update("healthy record", done, "")

        profile = measure_profile(trained.filter, filter, episodes, record["command"], data is None, report_record)
    checkpoint_hash = save_checkpoint(trained.filter, filter, record, output, profile)
    document = {"task": task, "filter": filter, "checkpoint_hash": checkpoint_hash, "record": record}
    return console.Result(document, _summary(filter, record), output)


def _summary(filter: str, record: Mapping[str, Any]) -> str:
    """Lines about training and the errors on clean held-out episodes."""
    lines = [f"{filter}, trained in {record['seconds']:.0f} s"]
    for name, metrics in record["metrics"].get("0", {}).items():
        lines.append(f"{name}: " + ", ".join(f"{key} {value:.2f}" for key, value in metrics["rmse"].items()))
    return "\n".join(lines)


def _option(name: str, value: object) -> str:
    """An option of a command, with a space before it; empty without a value."""
    return f" --{name} {value}" if value else ""


def _check_training(task: Task, episodes: Sequence[Episode], sample: bool) -> None:
    """Raise BadInput for a sample set without training episodes; warn of wrapping angles and of few held-out ones."""
    from beliefscope.filters.angles import wrapping_warning
    from beliefscope.inspect.diagnostics.healthy_comparison import MIN_HEALTHY

    if sample and task.simulate is not None and all(episode.split != "train" for episode in episodes):
        raise BadInput(
            f"the sample set of {task.name} has no training episodes; collect some, beliefscope collect "
            f"{task.name} -o {task.name}.h5, and train with --data {task.name}.h5"
        )
    if warning := wrapping_warning(episodes):
        console.note(f"Warning: {warning}")
    if (held_out := sum(episode.split != "train" for episode in episodes)) < MIN_HEALTHY:
        console.note(
            f"Warning: the data have {plural(held_out, 'held-out episode')}; diagnose needs a healthy record of at "
            f"least {MIN_HEALTHY}: collect more, or give it other clean data with --profile-from"
        )
